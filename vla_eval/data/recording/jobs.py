"""What a recording consists of, as data that is sent to workers: tries, shards, joins."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.config.dataset import OPTION_FIELDS, DatasetRecipe, fingerprint
from vla_eval.config.files import content_of
from vla_eval.core import EpisodeStart
from vla_eval.data.facts import DatasetFacts
from vla_eval.data.manifest import FailedSeed
from vla_eval.data.recording.demonstrations import SLOT, Attempt
from vla_eval.evaluation.episode_jobs import EpisodeGroup
from vla_eval.storage.continuing import known_device, without_device
from vla_eval.storage.run_file import RunFile
from vla_eval.workers.jobs import Job


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskPlan:
    """What is recorded of one task: environment and expert as in an evaluation, and the recipe."""

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
class _TaskJob(Job):
    """A job of one task."""

    plan: TaskPlan

    @property
    def setup_key(self) -> Hashable:
        """Jobs of one class share an environment."""
        return (self.plan.task, type(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptJob(_TaskJob):
    """Let the expert try one seed; the answer is an `Attempt`."""

    seed: int

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, seed {self.seed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardJob(_TaskJob):
    """Render and encode some attempts; the answer is where they are."""

    path: Path
    first_index: int
    attempts: tuple[Attempt, ...]

    @property
    def n_items(self) -> int:
        """Its attempts."""
        return len(self.attempts)

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, {self.path.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinJob(_TaskJob):
    """Put all shards of a task together at `path`; `facts` are without counts and digests."""

    path: Path
    shards: tuple[Path, ...]
    failed: tuple[FailedSeed, ...]
    facts: DatasetFacts

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.plan.task}, joining the shards"


def shard_jobs(plan: TaskPlan, kept: Sequence[Attempt], place: Callable[[int], Path]) -> tuple[ShardJob, ...]:
    """Return the jobs that render the kept attempts; `place` says where the shard of a number appears."""
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
    plan: TaskPlan, path: Path, *, shards: Sequence[ShardJob], failed: Sequence[Attempt], run_file: RunFile
) -> JoinJob:
    """Return the job that makes the dataset of a task at `path` from all of its shards."""
    started = run_file.description
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
        recipe_files=dict(started.recipes),
        environment=without_device(started.environment),
        device={name: str(value) for name, value in known_device(run_file).items()},
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
RecordingAnswer = Attempt | Path | DatasetFacts
