"""The levels of POPGym's thirteen families, one row each.

Levels: proroklab/popgym at 410d5aa. Where the official copy differs, popgym 1.0.7 is followed: MineSweeper is
truncated one step earlier, CountRecall can name the largest count, Autoencode and RepeatPrevious declare the
observations that they return.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple  # arguments of environments

from vla_eval.base_tasks.row import BaseTask, Figures, Memory

LEVELS = ("Easy", "Medium", "Hard")
SOURCE = "proroklab/popgym at 410d5aa, release 1.0.7 (MIT)"
HIDES_ACTION = ("Battleship", "MineSweeper", "MultiarmedBandit")
PLAYERS = "vla_eval.base_tasks.players"


class _Level(NamedTuple):
    """One level: its arguments, length, what is to be remembered, and the returns that are known."""

    kwargs: Mapping[str, Any]
    horizon_steps: int
    remember: str
    random: float
    memoryless: float | None
    best: float


class _Family(NamedTuple):
    """What the three levels of a family share."""

    name: str
    memory: tuple[Memory, ...]
    description: str
    success: str | None
    memoryless: str | None
    oracle: str
    best: str  # what the best return is of
    levels: tuple[_Level, _Level, _Level]


_ALL_RIGHT = "Every answer is right."
_MEASURED = "random, memoryless: measured over 100 to 3000 episodes"

_FAMILIES = (
    _Family(
        "RepeatFirst",
        ("object",),
        "Name the suit of the first card at every step.",
        _ALL_RIGHT,
        "cards:Constant",
        "cards:RepeatFirst",
        "exact",
        (
            _Level({"num_decks": 1}, 51, "one suit for 51 steps", -0.5, -0.499, 1.0),
            _Level({"num_decks": 8}, 415, "one suit for 415 steps", -0.5, -0.5, 1.0),
            _Level({"num_decks": 16}, 831, "one suit for 831 steps", -0.5, -0.5, 1.0),
        ),
    ),
    _Family(
        "RepeatPrevious",
        ("sequential", "object"),
        "Name the suit of the card seen k observations ago.",
        _ALL_RIGHT,
        "cards:AnotherSuit",
        "cards:RepeatPrevious",
        "exact",
        (
            _Level({"num_decks": 1, "k": 4}, 51, "a queue of 4 suits", -0.5, -0.491, 1.0),
            _Level({"num_decks": 2, "k": 32}, 103, "a queue of 32 suits", -0.5, -0.492, 1.0),
            _Level({"num_decks": 3, "k": 64}, 155, "a queue of 64 suits", -0.5, -0.498, 1.0),
        ),
    ),
    _Family(
        "Autoencode",
        ("sequential",),
        "See a deck card by card, then name the suits from the last card to the first.",
        _ALL_RIGHT,
        "cards:SuitShown",
        "cards:Autoencode",
        "exact",
        (
            _Level({"num_decks": 1}, 103, "52 suits in their order", -0.5, -0.471, 1.0),
            _Level({"num_decks": 2}, 207, "104 suits in their order", -0.5, -0.485, 1.0),
            _Level({"num_decks": 3}, 311, "156 suits in their order", -0.5, -0.490, 1.0),
        ),
    ),
    _Family(
        "CountRecall",
        ("object", "capacity"),
        "Name how often a kind of card has been dealt so far.",
        "A return of at least 0.9.",
        "cards:LikelyCount",
        "cards:CountRecall",
        "exact",
        (
            _Level({"num_decks": 1, "deck_type": "colors"}, 51, "2 counters", -0.923, -0.915, 1.0),
            _Level({"num_decks": 2, "deck_type": "suits"}, 103, "4 counters", -0.923, -0.92, 1.0),
            _Level({"num_decks": 4, "deck_type": "ranks"}, 207, "13 counters", -0.875, -0.87, 1.0),
        ),
    ),
    _Family(
        "HigherLower",
        ("object", "sequential"),
        "Bet whether the next card is higher or lower.",
        None,
        "cards:HigherThanSeven",
        "cards:HigherLower",
        "counting cards, measured over 300 episodes or more",
        (
            _Level({"num_decks": 1}, 51, "which of 52 cards are gone", 0.0, 0.496, 0.527),
            _Level({"num_decks": 2}, 103, "which of 104 cards are gone", 0.0, 0.497, 0.517),
            _Level({"num_decks": 3}, 155, "which of 156 cards are gone", 0.0, 0.498, 0.511),
        ),
    ),
    _Family(
        "Concentration",
        ("capacity",),
        "Turn two cards per turn, find the pairs.",
        "All cards are face up.",
        "boards:AnyHiddenCard",
        "boards:Concentration",
        "perfect recall with simple acting, measured over 100 episodes or more",
        (
            _Level({"num_decks": 1, "deck_type": "colors"}, 104, "up to 52 faces", -0.20, 0.46, 0.82),
            _Level({"num_decks": 2, "deck_type": "colors"}, 208, "up to 104 faces", -0.19, 0.46, 0.81),
            _Level({"num_decks": 1, "deck_type": "ranks"}, 104, "up to 52 faces", -0.83, -0.82, 0.70),
        ),
    ),
    _Family(
        "Battleship",
        ("spatial",),
        "Sink four ships on a board that is never shown.",
        "All ships are sunk.",
        "boards:AnyTile",
        "boards:Battleship",
        "hunting around hits without repeats, measured over 100 episodes or more",
        (
            _Level({"board_size": 8}, 64, "all shots, up to 64", -0.46, -0.46, 0.42),
            _Level({"board_size": 10}, 100, "all shots, up to 100", -0.41, -0.41, 0.49),
            _Level({"board_size": 12}, 144, "all shots, up to 144", -0.40, -0.40, 0.49),
        ),
    ),
    _Family(
        "MineSweeper",
        ("spatial",),
        "View all tiles without a mine of a board that is never shown.",
        "All safe tiles are viewed.",
        "boards:AnyTile",
        "boards:MineSweeper",
        "local logic with perfect recall, measured over 100 episodes or more",
        (
            _Level({"difficulty": "easy"}, 14, "14 tiles and their numbers", -0.25, -0.25, 0.70),
            _Level({"difficulty": "medium"}, 30, "30 tiles and their numbers", -0.40, -0.40, 0.26),
            _Level({"difficulty": "hard"}, 54, "54 tiles and their numbers", -0.44, -0.44, 0.27),
        ),
    ),
    _Family(
        "MultiarmedBandit",
        ("object", "capacity"),
        "Find out which arm pays most often, and pull it.",
        None,
        "cards:Constant",
        "bandit:Thompson",
        "Thompson sampling, measured over 300 episodes or more",
        (
            _Level({"num_bandits": 10, "episode_length": 200}, 200, "wins of 10 arms", 0.0, 0.0, 0.64),
            _Level({"num_bandits": 20, "episode_length": 400}, 400, "wins of 20 arms", 0.0, 0.0, 0.73),
            _Level({"num_bandits": 30, "episode_length": 600}, 600, "wins of 30 arms", 0.0, 0.0, 0.77),
        ),
    ),
    _Family(
        "LabyrinthExplore",
        ("spatial",),
        "Visit every cell of a maze, seeing 3 x 3 cells of it.",
        "Every free cell is visited.",
        "mazes:WallFollower",
        "mazes:NearestUnseen",
        "nearest unvisited cell first, with the map, measured over 100 episodes",
        (
            _Level({"maze_dims": (10, 10)}, 1023, "the visited cells of 11 x 11", -0.34, 0.97, 0.97),
            _Level({"maze_dims": (14, 14)}, 1023, "the visited cells of 15 x 15", -0.61, 0.92, 0.93),
            _Level({"maze_dims": (18, 18)}, 1023, "the visited cells of 19 x 19", -0.73, 0.86, 0.87),
        ),
    ),
    _Family(
        "LabyrinthEscape",
        ("spatial",),
        "Leave a maze, seeing 3 x 3 cells of it.",
        "The goal is reached.",
        "mazes:WallFollower",
        "mazes:ShortestPath",
        "shortest path, measured over 100 episodes",
        (
            _Level({"maze_dims": (10, 10)}, 1023, "where one has been in 11 x 11", -0.37, 0.95, 0.98),
            _Level({"maze_dims": (14, 14)}, 1023, "where one has been in 15 x 15", -0.84, 0.91, 0.96),
            _Level({"maze_dims": (18, 18)}, 1023, "where one has been in 19 x 19", -0.97, 0.85, 0.95),
        ),
    ),
    _Family(
        "VelocityOnlyCartPole",
        ("sequential",),
        "Balance a pole; velocities are seen. It needs no memory.",
        "The pole stands until the horizon.",
        "bodies:LinearCartPole",
        "bodies:CartPole",
        "exact",
        (
            _Level({"max_episode_length": 200}, 200, "nothing: velocities are enough", 0.112, 1.0, 1.0),
            _Level({"max_episode_length": 400}, 400, "nothing: velocities are enough", 0.056, 1.0, 1.0),
            _Level(
                {"max_episode_length": 600}, 600, "little: velocities are almost enough", 0.037, 0.84, 1.0
            ),
        ),
    ),
    _Family(
        "PositionOnlyCartPole",
        ("sequential",),
        "Balance a pole; positions are seen.",
        "The pole stands until the horizon.",
        "bodies:LinearCartPole",
        "bodies:CartPole",
        "exact",
        (
            _Level({"max_episode_length": 200}, 200, "the last two observations", 0.112, 0.22, 1.0),
            _Level({"max_episode_length": 400}, 400, "the last two observations", 0.056, 0.11, 1.0),
            _Level({"max_episode_length": 600}, 600, "the last two observations", 0.037, 0.073, 1.0),
        ),
    ),
    _Family(
        "NoisyPositionOnlyCartPole",
        ("sequential",),
        "Balance a pole; positions are seen, with noise.",
        "The pole stands until the horizon.",
        "bodies:LinearCartPole",
        "bodies:CartPole",
        "exact",
        (
            _Level({"noise_sigma": 0.1}, 200, "observations enough to average noise", 0.112, 0.24, 1.0),
            _Level({"noise_sigma": 0.2}, 200, "observations enough to average noise", 0.111, 0.19, 1.0),
            _Level({"noise_sigma": 0.3}, 200, "observations enough to average noise", 0.100, 0.17, 1.0),
        ),
    ),
    _Family(
        "PositionOnlyPendulum",
        ("sequential",),
        "Swing a pendulum up; its angle is seen.",
        None,
        None,
        "bodies:Pendulum",
        "a script with the state, measured",
        (
            _Level({"max_episode_length": 200}, 200, "the last two observations", 0.22, None, 0.90),
            _Level({"max_episode_length": 150}, 150, "the last two observations", 0.24, None, 0.87),
            _Level({"max_episode_length": 100}, 100, "the last two observations", 0.22, None, 0.81),
        ),
    ),
    _Family(
        "NoisyPositionOnlyPendulum",
        ("sequential",),
        "Swing a pendulum up; its angle is seen, with noise.",
        None,
        None,
        "bodies:Pendulum",
        "a script with the state, measured",
        (
            _Level({"noise_sigma": 0.1}, 200, "observations enough to average noise", 0.22, None, 0.90),
            _Level({"noise_sigma": 0.2}, 200, "observations enough to average noise", 0.22, None, 0.90),
            _Level({"noise_sigma": 0.3}, 200, "observations enough to average noise", 0.22, None, 0.90),
        ),
    ),
)


def popgym_rows() -> Iterator[BaseTask]:
    """Yield the rows of all families."""
    for family in _FAMILIES:
        for name, level in zip(LEVELS, family.levels, strict=True):
            yield BaseTask(
                name=f"{family.name}{name}-v0",
                family=family.name,
                entry_point="vla_eval.base_tasks.popgym_env:PopgymEnv",
                kwargs={"game": family.name, **level.kwargs},
                horizon_steps=level.horizon_steps,
                memory=family.memory,
                tier="diagnostic vector",
                extra="base",
                description=family.description,
                remember=level.remember,
                success=family.success,
                figures=Figures(
                    random=level.random,
                    memoryless=level.memoryless,
                    best=level.best,
                    source=f"{_MEASURED}; best: {family.best}",
                ),
                memoryless=family.memoryless and f"{PLAYERS}.{family.memoryless}",
                oracle=f"{PLAYERS}.{family.oracle}",
                source=SOURCE,
                hides_action=family.name in HIDES_ACTION,
            )
