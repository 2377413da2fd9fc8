"""The paper's three stages on a real arm, a row each: sentence, phases, what the operator does, figures.

Source: the paper, appendix "Real-World Experiments" and its table. It gives the sentences of the first two
stages and no durations: the third has the second's sentence here, and all durations are ours.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from vla_eval.errors import unknown_name
from vla_eval.task_state import Phase

TWIN = "real_twin/"  # namespace of the ids of the simulated stages
COLORS = ("red", "green", "blue")
"""The cubes, in the order of their indices as candidates."""
PLACES = ("on the arm's right", "in the middle", "on the arm's left")
CHANCE = 1 / len(COLORS)
"""Success rate of a perfect arm that knows neither sentence nor cue."""
EPISODES_PER_COLOR = 10
PAPER_EPISODES = EPISODES_PER_COLOR * len(COLORS)
DEMONSTRATIONS_PER_COLOR = 100
"""Source: the paper, as above: 300 per stage, of three colours."""
RESPONSE_SECONDS = 30.0  # ours: the paper gives no limit
PICK, REMEMBER = "Pick the {color} cube", "Remember the color of the cube and then pick the matching one"

TwinStage = Literal["visible", "thrown_in", "shuffled"]


class StagePhase(NamedTuple):
    """A part of an episode, begun by the operator; the arm is held still in all but the last."""

    phase: Phase  # what it is to a memory
    # what the operator does before it begins; `{color}`, `{others}`, `{place}`, `{order}`: of the episode
    asks: str
    twin_steps: int  # how long it takes in the simulated twin; 0 for the last, which lasts until the end


class Rates(NamedTuple):
    """Shares of episodes in which the right cube was touched, and picked."""

    touched: float
    picked: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One stage of the protocol."""

    name: str  # in ids of tasks
    twin: TwinStage  # argument `stage` of its simulated twin
    description: str  # one sentence
    instruction: str
    phases: tuple[StagePhase, ...]
    # the paper's π0.5, fine-tuned for each stage: `Total`, and each colour
    paper: Mapping[str, Rates] = field(hash=False)

    @property
    def twin_id(self) -> str:
        """Id of the task that simulates it."""
        return f"{TWIN}{self.name}-v0"

    @property
    def real_id(self) -> str:
        """Id of the task on a real arm."""
        return f"real/{self.name}-v0"


def _paper(**rates: tuple[float, float]) -> dict[str, Rates]:
    return {name: Rates(*pair) for name, pair in rates.items()}


_IN_ORDER = "From the arm's right: {order}."
_SHUFFLED = f"Put the {{others}} cubes under the cover, too, and change the places of all three. {_IN_ORDER}"
STAGES = (
    Stage(
        name="CubeVisible",
        twin="visible",
        description="Three cubes lie on the table, and the sentence names the colour of one: pick that one.",
        instruction=PICK,
        phases=(StagePhase("response", f"Put the three cubes on the table. {_IN_ORDER}", 0),),
        paper=_paper(Total=(1.00, 0.80), red=(1.00, 0.90), green=(1.00, 0.90), blue=(1.00, 0.60)),
    ),
    Stage(
        name="CubesThrownIn",
        twin="thrown_in",
        description="One cube lies on the table, then two others are thrown in: pick the first.",
        instruction=REMEMBER,
        phases=(
            StagePhase("cue", "Put the {color} cube on the table, alone: {place}.", 20),
            StagePhase("response", f"Throw in the {{others}} cubes. {_IN_ORDER}", 0),
        ),
        paper=_paper(Total=(0.63, 0.43), red=(0.70, 0.40), green=(0.70, 0.60), blue=(0.50, 0.30)),
    ),
    Stage(
        name="CubesShuffled",
        twin="shuffled",
        description=(
            "One cube lies on the table, is covered, and two others are mixed with it under the cover: pick "
            "the first."
        ),
        instruction=REMEMBER,
        phases=(
            StagePhase("cue", "Put the {color} cube on the table, alone: in the middle.", 20),
            StagePhase("delay", "Cover the {color} cube.", 20),
            StagePhase("delay", _SHUFFLED, 20),
            StagePhase("response", "Take the cover away.", 0),
        ),
        paper=_paper(Total=(0.10, 0.10), red=(0.10, 0.10), green=(0.20, 0.20), blue=(0.00, 0.00)),
    ),
)
"""In the paper's order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One episode as the operator knows it: what to place, not which policy will move the arm."""

    number: int  # in the plan, from 1: for people
    # of its record: the same in all stages, and for all policies, which meet the same colour and places
    seed: int
    stage: Stage
    color: int  # index of the right cube
    places: tuple[int, ...]  # of each cube, from the arm's right: where it lies when the choice is made

    def words(self, phase: StagePhase) -> str:
        """Return what the operator is asked to do before a phase begins."""
        color = COLORS[self.color]
        by_place = sorted(range(len(COLORS)), key=lambda index: self.places[index])
        return phase.asks.format(
            color=color,
            others=" and ".join(name for name in COLORS if name != color),
            place=PLACES[self.places[self.color]],
            order=", ".join(COLORS[index] for index in by_place),
        )


class Told(NamedTuple):
    """What a sentence says: the stages that have it, and the colour, if it names one."""

    stages: tuple[Stage, ...]
    color: str | None


def told_by(sentence: str) -> Told:
    """Return what the sentence of an episode says; letter case, blanks and a full stop do not count."""
    plain = _plain(sentence)
    told = {
        color: tuple(stage for stage in STAGES if _plain(stage.instruction.format(color=color)) == plain)
        for color in COLORS
    }
    named = {color: stages for color, stages in told.items() if stages}
    if len(named) == 1:
        (color, stages), *_ = named.items()
        return Told(stages, color)
    return Told(next(iter(named.values()), ()), None)


def _plain(sentence: str) -> str:
    return " ".join(sentence.casefold().split()).rstrip(".")


def stage_of(task: str) -> Stage:
    """Return the stage of a task's id, real or simulated, or of a stage's name.

    Raises:
        UnknownNameError: there is none.
    """
    known = {name: stage for stage in STAGES for name in (stage.name, stage.twin_id, stage.real_id)}
    if task not in known:
        raise unknown_name("stage", task, [stage.name for stage in STAGES])
    return known[task]
