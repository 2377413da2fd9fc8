"""`configs/*.yaml`: one evaluation."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from vla_eval.chunking import ChunkingSettings
from vla_eval.config.environment import AS_DESIGNED, AppearanceSettings, RenderSettings, SimBackend, Simulator
from vla_eval.config.files import check_run_name
from vla_eval.cue_view import CueViewKind
from vla_eval.errors import RecipeError
from vla_eval.memory_change import MemoryChange
from vla_eval.strict.bounds import (
    MAX_EPISODES,
    MAX_SERVER_ROWS,
    Bounds,
    Episodes,
    SecondsAllowed,
    Slots,
    Steps,
    Workers,
    check_bounds,
    check_seeds,
    require,
)
from vla_eval.strict.decoding import read_by
from vla_eval.strict.renamed import formerly

Outcomes = Literal["none", "all", "failures", "successes"]
Which = Outcomes | int


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureConfig:
    """What to capture of an evaluation; moves no result."""

    # which episodes get an mp4: by outcome, or the first N seeds of run 0 of each task, policy and
    # n_action_steps
    video: Which = "none"
    rrd: Which = "none"  # which episodes get a file for the rerun viewer, likewise
    # which episodes get a drawing of commands, the arm's way and borders of chunks, likewise
    strip: Which = "none"
    # whether each episode gets a file of what the policy remembers after each inference, if it has a memory
    memory: bool = False
    # whether each episode gets a file of small frames, at each control step until the response
    frames: bool = False
    frame_stride: Steps = 2  # control steps from one frame to the next

    def __post_init__(self) -> None:
        check_bounds(self, prefix="capture.")
        for name in ("video", "rrd", "strip"):
            which = getattr(self, name)
            if isinstance(which, int) and not 1 <= which <= MAX_EPISODES:
                raise RecipeError(
                    f"capture.{name} is {which}, expected 'none', 'all', 'failures', 'successes' or a "
                    f"number of episodes from 1 to {MAX_EPISODES}."
                )

    @property
    def is_on(self) -> bool:
        """Whether anything is captured."""
        return self.needs_images or self.strip != "none"

    @property
    def writes_files(self) -> bool:
        """Whether workers write into the run folder."""
        return self.is_on or self.memory or self.frames

    @property
    def needs_images(self) -> bool:
        """Whether what is captured shows images."""
        return self.video != "none" or self.rrd != "none"

    def films_afterwards(self, sim_backend: str) -> bool:
        """Whether episodes run without images, and those wanted once more: the outcome alone decides."""
        if not self.needs_images:
            return True
        return sim_backend == "cpu" and {self.video, self.rrd} <= {"none", "failures", "successes"}


def may_be_wanted(which: Which, *, run: int, index: int) -> bool:
    """Return whether the episode of a run with its seed of this index, from 0, may have to be captured."""
    return run == 0 and index < which if isinstance(which, int) else which != "none"


def is_wanted(which: Which, *, run: int, index: int, is_success: bool) -> bool:
    """Return whether the capture of a finished episode is kept."""
    if which in ("failures", "successes"):
        return is_success == (which == "successes")
    return may_be_wanted(which, run=run, index=index)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeoutConfig:
    """Seconds after which a worker that is busy with one thing is killed."""

    setup_seconds: SecondsAllowed = 900.0
    reset_seconds: SecondsAllowed = 120.0
    step_seconds: SecondsAllowed = 120.0
    inference_seconds: SecondsAllowed = 300.0

    def __post_init__(self) -> None:
        check_bounds(self, prefix="timeouts.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbedWorld:
    """Which world of a probe an evaluation is; `mikasa-vla probe` states it in `run.json`."""

    change: str  # what is changed, `none` for nothing; in a grid, the phase whose length is changed
    level: int | str | None = None  # by how much: a number, or a name; None where nothing is counted
    first_inference_step: int | None = None  # in a grid; None: not of a grid

    def __post_init__(self) -> None:
        in_grid = self.first_inference_step is not None
        require(not in_grid or isinstance(self.level, int), "level", self.level, "a number, in a grid")


def _one_text_each(policies: Any) -> Any:  # Any: plain data of YAML, not yet checked
    """Return entries `mine: {TASK: DIR}` as the texts `mine:TASK=DIR`, and all others as they are."""
    if not isinstance(policies, list):
        return policies
    return [one for entry in policies for one in (_texts(entry) if isinstance(entry, dict) else [entry])]


def _texts(entry: dict[str, Any]) -> Iterator[str]:
    for name, by_task in entry.items():
        for task, named in by_task.items() if isinstance(by_task, dict) else [("", by_task)]:
            several = named if isinstance(named, list) else [named]
            found = {name: by_task}
            is_text = bool(several) and all(isinstance(one, str) for one in (name, task, *several))
            require(is_text, "policies", found, "names, or NAME: {TASK: DIR}, or NAME: {TASK: [DIR, DIR]}")
            yield f"{name}:{task}={','.join(several)}" if task else f"{name}={','.join(several)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalConfig:
    """`configs/*.yaml`: one evaluation. `docs/evaluation.md` has the table of all keys."""

    name: str
    tasks: tuple[str, ...]
    policies: tuple[str, ...] = field(metadata=read_by(_one_text_each))
    description: str = ""
    protocol: str | None = None
    n_action_steps: tuple[int, ...] | None = None
    episodes: Episodes = 100
    seed_start: int = 1
    runs: Episodes = 1
    prompt_set: str = "paper"
    env: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    chunking: ChunkingSettings = field(default_factory=ChunkingSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    appearance: AppearanceSettings = AS_DESIGNED
    simulator: Simulator = "maniskill"
    sim_backend: SimBackend = "cpu"
    stop_at_success: bool = False
    reset_policy_at_step: Steps | None = None
    cue_view: CueViewKind = "as_shown"
    memory_change: MemoryChange | None = None
    eager_rendering: bool = False
    slots_per_worker: Slots = 1
    inference: Literal["auto", "in_process", "shared"] = "auto"
    inference_max_batch: Annotated[int, Bounds(1, MAX_SERVER_ROWS)] = 8
    compile: bool = False
    workers: Workers = "auto"
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)
    max_consecutive_errors: Episodes = 10
    capture: CaptureConfig = field(default_factory=CaptureConfig, metadata=formerly("recording"))
    world: ProbedWorld | None = None

    def __post_init__(self) -> None:
        check_run_name(self.name)
        check_bounds(self)
        check_seeds(self.seed_start, self.episodes)
        for name in ("tasks", "policies", "n_action_steps"):
            values = getattr(self, name)
            require(values is None or len(values) > 0, name, values, "at least one")
            require(values is None or len(set(values)) == len(values), name, list(values or ()), "no doubles")
        for n_action_steps in self.n_action_steps or (1,):
            self.chunking.at(n_action_steps)  # checks the ranges


OPTION_FIELDS = (
    *("name", "description", "protocol", "workers", "timeouts", "max_consecutive_errors", "capture"),
    "world",
)
"""Fields of `EvalConfig` that move no result: they may differ when a run is resumed."""
