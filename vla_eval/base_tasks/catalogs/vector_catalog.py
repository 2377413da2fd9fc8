"""The levels of the vector environments that are written again from their rules, one row each."""

from collections.abc import Iterator

from vla_eval.base_tasks.row import BaseTask, Figures

PLAYERS = "vla_eval.base_tasks.players"


# Without a limit, random and memoryless would be n - 2 n² and n - n².
_CARDS = "measured over 100 episodes or more, within the horizon; best: perfect recall"


def vector_rows() -> Iterator[BaseTask]:
    """Yield the rows of all families."""
    yield from _memory_length()
    yield from _memory_cards()
    yield from _t_maze()
    yield from _numpad()


def _memory_length() -> Iterator[BaseTask]:
    for level, n_delay_steps, n_bits in (("Easy", 10, 1), ("Medium", 30, 1), ("Hard", 100, 3)):
        yield BaseTask(
            name=f"MemoryLength{level}-v0",
            family="MemoryLength",
            entry_point="vla_eval.base_tasks.memory_length:MemoryLengthEnv",
            kwargs={"n_delay_steps": n_delay_steps, "n_bits": n_bits},
            horizon_steps=n_delay_steps + 1,
            memory=("object",),
            tier="diagnostic vector",
            description="Name one of the bits that were shown at the beginning.",
            remember=f"{n_bits} bit{'s' * (n_bits > 1)} for {n_delay_steps - 1} steps",
            success="The bit named at the last step is right.",
            figures=Figures(random=0.0, memoryless=0.0, best=1.0, source="exact"),
            memoryless=f"{PLAYERS}.memory_length:Coin",
            oracle=f"{PLAYERS}.memory_length:Oracle",
            source="google-deepmind/bsuite at effafc0 (Apache-2.0)",
        )


def _memory_cards() -> Iterator[BaseTask]:
    figures = {
        5: Figures(random=-37.9, memoryless=-19.7, best=-5.3, source=_CARDS),
        10: Figures(random=-133.0, memoryless=-84.5, best=-14.2, source=_CARDS),
        30: Figures(random=-590.0, memoryless=-586.0, best=-51.8, source=_CARDS),
    }
    for level, n_pairs, horizon_steps in (("Easy", 5, 50), ("Medium", 10, 150), ("Hard", 30, 600)):
        yield BaseTask(
            name=f"MemoryCards{level}-v0",
            family="MemoryCards",
            entry_point="vla_eval.base_tasks.memory_cards:MemoryCardsEnv",
            kwargs={"n_pairs": n_pairs},
            horizon_steps=horizon_steps,
            memory=("capacity",),
            tier="diagnostic vector",
            description="One card is face up: name the place of its mate.",
            remember=f"up to {2 * n_pairs} faces, for the whole episode",
            success="All pairs are found before the horizon.",
            figures=figures[n_pairs],
            memoryless=f"{PLAYERS}.memory_cards:AnyHiddenPlace",
            oracle=f"{PLAYERS}.memory_cards:PerfectRecall",
            source="kevslinger/DTQN at 9f8d72b (MIT)",
        )


def _t_maze() -> Iterator[BaseTask]:
    length = 10
    for name, is_dense, random in (("T-Maze-v0", False, 2.4e-7), ("T-Maze-Dense-v0", True, -0.967)):
        yield BaseTask(
            name=name,
            family="T-Maze",
            entry_point="vla_eval.base_tasks.t_maze:TMazeEnv",
            kwargs={"length": length, "is_dense": is_dense},
            horizon_steps=length + 1,
            memory=("object",),
            tier="diagnostic vector",
            description="Walk along a corridor, turn to the side that was shown at its start.",
            remember=f"1 bit for {length} steps",
            success="The last step ends at the goal.",
            figures=Figures(random=random, memoryless=0.5, best=1.0, source="exact"),
            memoryless=f"{PLAYERS}.corridors:TurnsUp",
            oracle=f"{PLAYERS}.corridors:Oracle",
            source="twni2016/Memory-RL at c9b8b39 (MIT)",
        )


def _numpad() -> Iterator[BaseTask]:
    known = "best: measured, a script that knows the sequence; random: measured"
    rows = (
        ("Discrete", 500, Figures(random=6.7, memoryless=None, best=391.0, source=known)),
        ("Continuous", 200, Figures(random=0.9, memoryless=None, best=28.5, source=known)),
    )
    for name, horizon_steps, figures in rows:
        yield BaseTask(
            name=f"Numpad-{name}-v0",
            family="Numpad",
            entry_point=f"vla_eval.base_tasks.numpad:{name}NumpadEnv",
            horizon_steps=horizon_steps,
            memory=("sequential",),
            tier="diagnostic vector",
            description="Find out in which order four tiles have to be pressed, and repeat it.",
            remember="4 tiles, found by trial, for the rest of the episode",
            success="The sequence is completed at least once.",
            figures=figures,
            memoryless=None,
            oracle=f"{PLAYERS}.numpad:{name}Oracle",
            source="Syrlander/numpad-gym at 24e04e7 (no licence: rules only), after Humplik et al. 2019",
        )
