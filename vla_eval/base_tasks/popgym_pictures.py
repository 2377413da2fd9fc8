"""What pictures of POPGym's games show: boards of cells, lines of text. They only read the game."""

from typing import Any

import numpy as np

from vla_eval.base_tasks.drawing import BAD, GOOD, HIDDEN, INK, MARK, PAPER, SHOWN, Cell

Board = tuple[list[list[Cell]], list[str]]

RANKS = ("A", "2", "3", "4", "5", "6", "7", "8", "9", "10", "J", "Q", "K")
SUITS = ("spades", "diamonds", "clubs", "hearts")
TRACK_CELLS = 15  # of a cart's way


def cards(inner: Any, seen: Any) -> Board:
    """Show the card that is seen; of Autoencode whether it watches or answers."""
    name = type(inner).__name__
    if name == "HigherLower":
        return [[Cell(RANKS[seen], SHOWN)]], ["is the next card higher or lower?"]
    if name == "Autoencode":
        mode, suit = (int(number) for number in seen)
        line = f"watch: {SUITS[suit]}" if mode else "name the suits, the last one first"
        return [[Cell(SUITS[suit][0] if mode else "?", SHOWN if mode else HIDDEN)]], [line]
    return [[Cell(SUITS[seen][0], SHOWN)]], [f"a card of {SUITS[seen]}"]


def counts(inner: Any, seen: Any) -> Board:
    """Show the value dealt and the value asked for."""
    value, query = (str(int(number)) for number in seen)
    return [[Cell(value, SHOWN), Cell(query, MARK)]], ["left: dealt", "right: how often was it dealt?"]


def concentration(inner: Any, seen: Any) -> Board:
    """Show the table as the player sees it."""
    cells = [Cell("", HIDDEN) if v == inner.facedown_card else Cell(str(v), SHOWN) for v in seen.tolist()]
    return _rows(cells, 13), [f"{sum(cell.color == SHOWN for cell in cells)} cards face up"]


def battleship(inner: Any, seen: Any) -> Board:
    """Show hits and misses, which the player does not see."""
    board = [
        [
            Cell("x" if hit else "", GOOD if hit else BAD) if tried else Cell("", HIDDEN)
            for hit, tried in zip(row, tries, strict=True)
        ]
        for row, tries in zip(inner.board.tolist(), inner.guesses.tolist(), strict=True)
    ]
    return board, ["hit" if seen else "no hit", f"{inner.hits} of {sum(inner.ship_sizes)} found"]


def minesweeper(inner: Any, seen: Any) -> Board:
    """Show the tiles that were viewed, which the player does not see."""
    viewed = 2
    board = [
        [
            Cell(str(number), SHOWN) if state == viewed else Cell("", HIDDEN)
            for state, number in zip(states, numbers, strict=True)
        ]
        for states, numbers in zip(inner.hidden_grid.tolist(), inner.neighbor_grid.tolist(), strict=True)
    ]
    return board, [f"{seen} mines around the last tile"]


def bandit(inner: Any, seen: Any) -> Board:
    """Show whether the last arm paid."""
    color = GOOD if seen else BAD
    return [[Cell("+" if seen else "-", color)]], [f"step {inner.num_steps}", f"{inner.num_bandits} arms"]


def maze(inner: Any, seen: Any) -> Board:
    """Show the maze with what was visited and the agent; the player sees 3 x 3 cells of it."""
    wall, goal = 1, 3
    board = []
    for i, row in enumerate(inner.maze.grid.tolist()):
        cells = []
        for j, cell in enumerate(row):
            visited = PAPER if inner.explored[i, j] else HIDDEN
            color = {wall: INK, goal: GOOD}.get(cell, visited)
            cells.append(Cell("", MARK if (i, j) == tuple(inner.position) else color))
        board.append(cells)
    return board, []


def cartpole(inner: Any, seen: Any) -> Board:
    """Show cart and pole as they truly are."""
    x, _, theta, _ = (float(number) for number in inner.state)
    place = int(np.clip((x / inner.x_threshold + 1) / 2 * TRACK_CELLS, 0, TRACK_CELLS - 1))
    track = [Cell("", MARK if j == place else PAPER) for j in range(TRACK_CELLS)]
    return [track], [f"cart {x:+.2f} m", f"pole {np.degrees(theta):+.1f} degrees"]


def pendulum(inner: Any, seen: Any) -> Board:
    """Show where the tip is; up is up."""
    theta, speed = (float(number) for number in inner.state)
    size, middle = 7, 3
    tip = round(middle - 3 * np.cos(theta)), round(middle + 3 * np.sin(theta))
    board = [
        [
            Cell("", MARK if (i, j) == tip else INK if (i, j) == (middle, middle) else PAPER)
            for j in range(size)
        ]
        for i in range(size)
    ]
    return board, [f"{np.degrees(theta) % 360:.0f} degrees from upright, {speed:+.1f} rad/s"]


def _rows(cells: list[Cell], width: int) -> list[list[Cell]]:
    return [cells[k : k + width] for k in range(0, len(cells), width)]
