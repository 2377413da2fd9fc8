"""Published results as data, from `published.yaml`; a value that a source does not state is None."""

import functools
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal, NamedTuple

from vla_eval.errors import unknown_name
from vla_eval.strict.bounds import require
from vla_eval.strict.decoding import decode
from vla_eval.strict.yaml_data import load_yaml

PUBLISHED_FILE = Path(__file__).with_name("published.yaml")
PAPER = "mikasa"  # key of the benchmark's paper among the sources
PAPER_FAMILY = "VLA"
MEASURED_HERE, DIGEST = "[measured here]", "†"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Where a result is from; without a link: this repository."""

    title: str
    link: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedRate:
    """A success rate in [0, 1], and its spread if one is stated; `PublishedResult.spread` says which."""

    rate: float
    spread: float | None = None

    def __post_init__(self) -> None:
        require(0 <= self.rate <= 1, "rate", self.rate, "a number from 0 to 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """Results that are listed together."""

    title: str
    tasks: tuple[str, ...]
    # whether the mean of all tasks is the figure that is compared; then it is computed where a source
    # states every task but no mean
    mean_over_tasks: bool
    # task -> control steps of an episode in the suites of these names; the paper's table of tasks
    horizon_steps: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedResult:
    """One method as one source reports it. None, or nothing, is what the source does not state."""

    method: str
    source: str  # key of `Published.sources`; where: the place in it
    board: str  # key of `Published.boards`
    family: str | None = None
    where: str | None = None
    # read in the source itself, or in digests of a source that could not be read
    read: Literal["source", "digest"] = "source"
    suite: str | None = None  # whose tasks of these names
    robot: str | None = None
    horizon: Literal["registered"] | None = None  # as long as the suite has them: `Board.horizon_steps`
    control_mode: str | None = None
    image_px: int | None = None
    n_action_steps: int | None = None
    training: str | None = None  # one model per task, or one for all tasks
    runs: int | None = None
    episodes: int | None = None
    seeds: str | None = None
    spread: str | None = None  # which spread the rates have
    rates: dict[str, PublishedRate] = field(default_factory=dict)
    mean: PublishedRate | None = None  # as the source states it
    # field of this class -> what is inferred of it and not known; such a field has no value
    perhaps: dict[str, str] = field(default_factory=dict)
    differs: tuple[str, ...] = ()  # what is known to differ from the protocol or from other rows
    contested: dict[str, str] = field(default_factory=dict)  # task -> what contradicts its rate
    is_measured_here: bool = False

    def __post_init__(self) -> None:
        known = {one.name: getattr(self, one.name) for one in fields(self)}
        for name in self.perhaps:
            require(name in known, f"{self.method}: perhaps", name, "a field of a published result")
            require(known[name] is None, f"{self.method}: {name}", known[name], "no value beside perhaps")

    @property
    def label(self) -> str:
        """The method, with a mark if it was measured by this project or is from a digest alone."""
        marks = [MEASURED_HERE] * self.is_measured_here + [DIGEST] * (self.read == "digest")
        return " ".join((self.method, *marks))


@dataclass(frozen=True, slots=True, kw_only=True)
class Published:
    """The whole file."""

    checked: str
    sources: dict[str, Reference]
    boards: dict[str, Board]
    results: tuple[PublishedResult, ...]

    def __post_init__(self) -> None:
        for one in self.results:
            require(one.source in self.sources, f"{one.method}: source", one.source, "one of sources")
            require(one.board in self.boards, f"{one.method}: board", one.board, "one of boards")
            tasks = self.boards[one.board].tasks
            others = [task for task in (*one.rates, *one.contested) if task not in tasks]
            require(not others, f"{one.method}: rates", others, "tasks of its board")
            unrated = [task for task in one.contested if task not in one.rates]
            require(not unrated, f"{one.method}: contested", unrated, "tasks with a rate")

    def of_board(self, name: str) -> tuple[PublishedResult, ...]:
        """Return the results of a board, in the file's order, or raise `UnknownNameError`."""
        if name not in self.boards:
            raise unknown_name("list of published results", name, self.boards, where="--published")
        return tuple(one for one in self.results if one.board == name)

    def best_of(self, task: str, *, board: str) -> tuple[PublishedResult, ...]:
        """Return the results of others with the highest rate of a task on a board; none without a rate."""
        rated = [one for one in self.of_board(board) if task in one.rates and not one.is_measured_here]
        highest = max((one.rates[task].rate for one in rated), default=None)
        return tuple(one for one in rated if one.rates[task].rate == highest)

    def mean_of(self, result: PublishedResult) -> float | None:
        """Return the mean over the board's tasks: as stated, or computed if every task has a rate."""
        if result.mean is not None:
            return result.mean.rate
        board = self.boards[result.board]
        if not board.mean_over_tasks or set(result.rates) != set(board.tasks):
            return None
        return sum(one.rate for one in result.rates.values()) / len(board.tasks)


class PaperFigure(NamedTuple):
    """One cell of the paper's table of VLA models, which states all of it."""

    task: str
    model: str
    n_action_steps: int | None
    success_once: float
    sem: float | None


@functools.cache
def load_published() -> Published:
    """Read the file that ships."""
    text = PUBLISHED_FILE.read_text(encoding="utf-8")
    return decode(Published, load_yaml(text, where=PUBLISHED_FILE.name), where=PUBLISHED_FILE.name)


def paper_figures() -> list[PaperFigure]:
    """Return the cells of the paper's table of VLA models, model by model.

    Source: "Memory, Benchmark & Robots" (ICLR 2026), appendix "VLA baselines", table "Performance of VLA
    models on selected memory-intensive tasks from the MIKASA-Robo benchmark". Its caption: success rates
    over 100 evaluation episodes, mean ± SEM; three training runs, seeds 1 to 100 (appendix "Experiments
    Reproducing and Compute Resources").
    """
    return [
        PaperFigure(task, one.method, one.n_action_steps, rate.rate, rate.spread)
        for one in load_published().results
        if one.source == PAPER and one.family == PAPER_FAMILY
        for task, rate in one.rates.items()
    ]
