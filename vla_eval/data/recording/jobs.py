"""What a recording consists of, as data that is sent to workers: tries, shards, joins.

Knows nothing of lerobot, simulators or processes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_eval.config.dataset import OPTION_FIELDS, DatasetRecipe, fingerprint
from vla_eval.config.files import content_of
from vla_eval.core import EpisodeStart
from vla_eval.data.facts import DatasetFacts
from vla_eval.data.manifest import FailedSeed
from vla_eval.data.recording.demonstrations import SLOT, Attempt
from vla_eval.evaluation.episode_jobs import EpisodeGroup
from vla_eval.storage.run_file import JsonValue


class SetupKey(NamedTuple):
    """What the jobs share that one environment can do."""

    task: str
    kind: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskPlan:
    """What is recorded of one task.

    Attributes:
        group: task, environment and expert, as an evaluation has them.
        task_version: version of the task's rules.
        expert_version: version of the expert's recipe.
        recipe: the recipe of the dataset.
    """

    group: EpisodeGroup
    task_version: int
    expert_version: int
    recipe: DatasetRecipe

    @property
    def task(self) -> str:
        """Task id."""
        return self.group.key.task

    def start(self, seed: int, *, horizon_steps: int) -> EpisodeStart:
        """Return the episode of a seed."""
        return EpisodeStart(
            slot=SLOT,
            task=self.task,
            seed=seed,
            run=0,
            instruction=self.group.instruction,
            horizon_steps=horizon_steps,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptJob:
    """Let the expert try one seed; the answer is an `Attempt`."""

    plan: TaskPlan
    seed: int

    @property
    def setup_key(self) -> SetupKey:
        """See `workers.Job`."""
        return SetupKey(self.plan.task, "attempt")

    @property
    def n_items(self) -> int:
        """One seed."""
        return 1

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, seed {self.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardJob:
    """Render and encode some attempts; the answer is a `ShardWritten`."""

    plan: TaskPlan
    path: Path
    first_index: int
    attempts: tuple[Attempt, ...]

    @property
    def setup_key(self) -> SetupKey:
        """See `workers.Job`."""
        return SetupKey(self.plan.task, "render")

    @property
    def n_items(self) -> int:
        """Its attempts."""
        return len(self.attempts)

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, {self.path.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinJob:
    """Put the shards of a task together; the answer is a `DatasetWritten`.

    Attributes:
        plan: what was recorded.
        path: where the dataset is to appear; its draft is written in the folder of the shards.
        shards: all of them, in order.
        failed: seeds at which the expert failed.
        facts: what is known of the dataset but counts, device and digests.
    """

    plan: TaskPlan
    path: Path
    shards: tuple[Path, ...]
    failed: tuple[FailedSeed, ...]
    facts: DatasetFacts

    @property
    def setup_key(self) -> SetupKey:
        """See `workers.Job`."""
        return SetupKey(self.plan.task, "join")

    @property
    def n_items(self) -> int:
        """One dataset."""
        return 1

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, joining the shards"


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """With what a recording was made.

    Attributes:
        recipe_files: `policies/oracle` -> sha256 of the file; likewise the prompts and weights.
        environment: commit, versions and machine.
        device: what is known of the device that rendered.
    """

    recipe_files: Mapping[str, str]
    environment: Mapping[str, JsonValue]
    device: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardWritten:
    """A shard is on the disk."""

    n_episodes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetWritten:
    """A dataset is on the disk, complete."""

    facts: DatasetFacts


def shard_jobs(plan: TaskPlan, kept: Sequence[Attempt], place: Callable[[int], Path]) -> tuple[ShardJob, ...]:
    """Return the jobs that render the kept attempts.

    Args:
        plan: what is recorded.
        kept: the attempts, in their order.
        place: number of a shard -> where it appears.
    """
    size = plan.recipe.episodes_per_shard
    return tuple(
        ShardJob(
            plan=plan,
            path=place(first // size),
            first_index=first,
            attempts=tuple(kept[first : first + size]),
        )
        for first in range(0, len(kept), size)
    )


def join_job(
    plan: TaskPlan, path: Path, *, shards: Sequence[ShardJob], failed: Sequence[Attempt], origin: Origin
) -> JoinJob:
    """Return the job that makes the dataset of a task.

    Args:
        plan: what was recorded.
        path: where the dataset is to appear.
        shards: all of them, in order; they are there.
        failed: the attempts that did not succeed.
        origin: with what it was recorded.
    """
    facts = DatasetFacts(
        complete=True,
        name=plan.recipe.name,
        task=plan.task,
        task_version=plan.task_version,
        instruction=plan.group.instruction,
        state=plan.recipe.state,
        n_episodes=0,
        n_frames=0,
        n_failed_seeds=len(failed),
        recipe=content_of(plan.recipe, options=OPTION_FIELDS),
        recipe_sha256=fingerprint(plan.recipe),
        recipe_files=dict(origin.recipe_files),
        environment=dict(origin.environment),
        device=dict(origin.device),
        files={},
    )
    return JoinJob(
        plan=plan,
        path=path,
        shards=tuple(job.path for job in shards),
        failed=tuple(FailedSeed(seed=one.seed, n_steps=one.n_steps) for one in failed),
        facts=facts,
    )


RecordingJob = AttemptJob | ShardJob | JoinJob
RecordingAnswer = Attempt | ShardWritten | DatasetWritten
