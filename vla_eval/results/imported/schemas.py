"""What is read of other programs' JSON. Fields that are not read may be anything."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints  # Any: JSON

from vla_eval.strict.json_text import Count, Positive, Source, as_dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LerobotMetrics:
    """`TaskMetrics` of lerobot 0.6.1, scripts/lerobot_eval.py."""

    successes: tuple[bool, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LerobotTask:
    """One of `per_task`."""

    task_group: str
    task_id: Count
    metrics: LerobotMetrics


@dataclass(frozen=True, slots=True, kw_only=True)
class LerobotOverall:
    """`overall`; percent."""

    pc_success: float
    n_episodes: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class LerobotEval:
    """`eval_info.json`."""

    per_task: tuple[LerobotTask, ...]
    overall: LerobotOverall


@dataclass(frozen=True, slots=True, kw_only=True)
class AllenaiEpisode:
    """One episode of allenai's vla-evaluation-harness 0.8.0, results/collector.py."""

    metrics: dict[str, Any]
    failure_reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AllenaiTask:
    """One task; its mean counts errors as failures."""

    task: str
    episodes: tuple[AllenaiEpisode, ...]
    mean_success: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AllenaiResult:
    """Its result of a benchmark, as written or exported."""

    benchmark: str
    harness_version: str
    tasks: tuple[AllenaiTask, ...]
    partial: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class OfficialTask:
    """`ENV_ID.json` of the official runner, mikasa-robo-suite 1.0.0, vla/benchmarking.py."""

    env_id: str
    n_episodes: Positive
    successes: tuple[bool, ...]
    sr: float
    control_mode: str
    action_chunk_size: Positive
    episode_seeds: tuple[Count, ...]
    benchmark_commit: str | None
    model: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectSpec:
    """`eval` of a log of inspect-robots 0.60.0, log.py."""

    task: str
    policy: str
    embodiment: str
    inspect_robots_version: str
    max_steps: Positive | None = None
    policy_checkpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectSample:
    """One scene; a trial that ended in an error has no score."""

    scene_id: str
    epochs: tuple[dict[str, float], ...]
    instruction: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectLog:
    """The whole log."""

    version: int
    status: str
    eval: InspectSpec
    samples: tuple[InspectSample, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectAiSpec:
    """`eval` of a log of inspect_ai 0.3.285, log/_log.py."""

    task: str
    model: str


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectAiResults:
    """Its own count."""

    completed_samples: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectAiSample:
    """One sample of one epoch; one that raised has no score, unless the task asked for one."""

    scores: dict[str, dict[str, Any]] | None = None  # name of a scorer -> its score, with `value`
    error: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectAiLog:
    """The whole log, written with `--log-format json`."""

    version: int
    status: str
    eval: InspectAiSpec
    results: InspectAiResults
    samples: tuple[InspectAiSample, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobostatsProtocol:
    """What a line says of how it was collected."""

    execution_horizon: Positive | None = None
    max_steps: Positive | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RobostatsRecord:
    """One line of `EpisodeRecorder`, robostats 0.2.0, recording.py."""

    policy_id: str
    task_id: str
    success: bool
    seed: Count | None = None
    protocol: RobostatsProtocol | None = None


def read_part[T](cls: type[T], data: Any, source: Source) -> T:
    """Return the fields of a dataclass from JSON that may have others; errors as `as_dataclass`."""
    return as_dataclass(cls, _only(cls, data), source)


def _only(hint: Any, data: Any) -> Any:
    """Leave out what no field is for, also in lists of dataclasses."""
    if is_dataclass(hint) and isinstance(data, Mapping):
        hints = get_type_hints(hint)
        names = [one.name for one in fields(hint) if one.name in data]
        return {name: _only(hints[name], data[name]) for name in names}
    if get_origin(hint) is tuple and isinstance(data, list):
        return [_only(get_args(hint)[0], one) for one in data]
    inner = [one for one in get_args(hint) if is_dataclass(one)]
    return _only(inner[0], data) if inner and isinstance(data, Mapping) else data
