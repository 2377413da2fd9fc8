"""What frames of POPGym's games show: boards of cells, lines of text. They only read the game."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import (
    BAD,
    GOOD,
    HIDDEN,
    INK,
    MARK,
    PAPER,
    SHOWN,
    Cell,
    board_picture,
    line_picture,
)

Picture = NDArray[np.uint8]

RANKS = ("A", "2", "3", "4", "5", "6", "7", "8", "9", "10", "J", "Q", "K")
SUITS = ("spades", "diamonds", "clubs", "hearts")


def cards(inner: Any, seen: Any) -> Picture:
    """Show the card that is seen; of Autoencode whether it watches or answers."""
    name = type(inner).__name__
    if name == "HigherLower":
        return board_picture([[Cell(RANKS[seen], SHOWN)]], ["is the next card higher or lower?"])
    if name == "Autoencode":
        mode, suit = (int(number) for number in seen)
        line = f"watch: {SUITS[suit]}" if mode else "name the suits, the last one first"
        return board_picture([[Cell(SUITS[suit][0] if mode else "?", SHOWN if mode else HIDDEN)]], [line])
    return board_picture([[Cell(SUITS[seen][0], SHOWN)]], [f"a card of {SUITS[seen]}"])


def counts(inner: Any, seen: Any) -> Picture:
    """Show the value dealt and the value asked for."""
    value, query = (str(int(number)) for number in seen)
    return board_picture(
        [[Cell(value, SHOWN), Cell(query, MARK)]], ["left: dealt", "right: how often was it dealt?"]
    )


def concentration(inner: Any, seen: Any) -> Picture:
    """Show the table as the player sees it."""
    cells = [Cell("", HIDDEN) if v == inner.facedown_card else Cell(str(v), SHOWN) for v in seen.tolist()]
    return board_picture(_rows(cells, 13), [f"{sum(cell.color == SHOWN for cell in cells)} cards face up"])


def battleship(inner: Any, seen: Any) -> Picture:
    """Show hits and misses, which the player does not see."""
    board = [
        [
            Cell("x" if hit else "", GOOD if hit else BAD) if tried else Cell("", HIDDEN)
            for hit, tried in zip(row, tries, strict=True)
        ]
        for row, tries in zip(inner.board.tolist(), inner.guesses.tolist(), strict=True)
    ]
    found = f"{inner.hits} of {sum(inner.ship_sizes)} found"
    return board_picture(board, ["hit" if seen else "no hit", found])


def minesweeper(inner: Any, seen: Any) -> Picture:
    """Show the tiles that were viewed, which the player does not see."""
    viewed = 2
    board = [
        [
            Cell(str(number), SHOWN) if state == viewed else Cell("", HIDDEN)
            for state, number in zip(states, numbers, strict=True)
        ]
        for states, numbers in zip(inner.hidden_grid.tolist(), inner.neighbor_grid.tolist(), strict=True)
    ]
    return board_picture(board, [f"mines around the last tile: {seen}"])


def bandit(inner: Any, seen: Any) -> Picture:
    """Show whether the last arm paid."""
    last = Cell("+" if seen else "-", GOOD if seen else BAD) if inner.num_steps else Cell()
    return board_picture([[last]], [f"step {inner.num_steps}", f"{inner.num_bandits} arms"])


def maze(inner: Any, seen: Any) -> Picture:
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
    return board_picture(board)


def cartpole(inner: Any, seen: Any) -> Picture:
    """Show cart and pole as they truly are."""
    x, _, theta, _ = (float(number) for number in inner.state)
    place = x / inner.x_threshold  # -1 to 1
    tip = (place + 0.8 * np.sin(theta), 0.8 * np.cos(theta))
    cart = ((place - 0.12, 0.0), (place + 0.12, 0.0), INK, 12)
    lines = (((-1.2, -0.08), (1.2, -0.08), HIDDEN, 2), cart, ((place, 0.0), tip, MARK, 6))
    return line_picture(lines, [f"cart {x:+.2f} m, pole {np.degrees(theta):+.1f} degrees"])


def pendulum(inner: Any, seen: Any) -> Picture:
    """Show the pendulum; up is up."""
    theta, speed = (float(number) for number in inner.state)
    tip = (-0.7 * np.sin(theta), 0.7 * np.cos(theta))
    words = f"{np.degrees(theta) % 360:.0f} degrees from upright, {speed:+.1f} rad/s"
    return line_picture([((0.0, 0.0), tip, MARK, 10)], [words])


def _rows(cells: list[Cell], width: int) -> list[list[Cell]]:
    return [cells[k : k + width] for k in range(0, len(cells), width)]
