"""The inside of a worker that records: tries seeds, renders and encodes shards, puts datasets together."""

import dataclasses
import errno
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.core import FloatArray, Policy, SimEnv
from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.facts import DatasetFacts
from vla_eval.data.manifest import (
    FAILED_FILE,
    MANIFEST_FILE,
    MIKASA_FOLDER,
    RECORDING_FILE,
    RecordedEpisode,
    write_entry,
    write_lines,
)
from vla_eval.data.recording.demonstrations import (
    Attempt,
    EpisodeLog,
    NoisyEnv,
    attempt,
    images_digests,
    replay_attempt,
)
from vla_eval.data.recording.jobs import (
    AttemptJob,
    JoinJob,
    RecordingAnswer,
    RecordingJob,
    ShardJob,
    TaskPlan,
)
from vla_eval.data.recording.shard_writer import ShardWriter, join_shards
from vla_eval.data.simulator_runner import SimulatorRunner
from vla_eval.errors import VlaEvalError
from vla_eval.evaluation.worker import make_policy
from vla_eval.features import CAMERA_KEYS, dataset_features, frame_values
from vla_eval.robots.find import robot_of
from vla_eval.storage.drafts import draft_path, publish, remove_drafts
from vla_eval.storage.durable import DISK_TROUBLE, storage_full
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import DeviceFound

NEARLY_FULL_BYTES = 1 << 24  # an encoder's error does not say that the disk is full; this little left does


class RecordingRunner(SimulatorRunner[RecordingJob, RecordingAnswer]):
    """Tries seeds, writes shards, and joins them; keeps the expert, too."""

    def __init__(self, heartbeat: Heartbeat, tell: Callable[[DeviceFound], None]) -> None:
        super().__init__(heartbeat, tell)
        self._expert: Policy | None = None

    def close(self) -> None:
        """Release simulator and expert."""
        super().close()
        self._expert = None

    def _do(self, job: RecordingJob) -> RecordingAnswer:
        if isinstance(job, AttemptJob):
            return self._attempt(job)
        return self._write_shard(job) if isinstance(job, ShardJob) else join_dataset(job)

    def _explained(self, exc: BaseException, job: RecordingJob) -> BaseException:
        if isinstance(exc, VlaEvalError) or isinstance(job, AttemptJob):
            return exc
        is_known = isinstance(exc, OSError) and exc.errno in DISK_TROUBLE
        if is_known or shutil.disk_usage(job.path.parent).free < NEARLY_FULL_BYTES:
            full = exc if isinstance(exc, OSError) else OSError(errno.ENOSPC, str(exc))
            return storage_full(job.path, full)
        return exc

    def _attempt(self, job: AttemptJob) -> Attempt:
        plan = job.plan
        env = self._make_env(dataclasses.replace(plan.group.env, privileged=True))
        if self._expert is None:
            self._expert = make_policy(plan.group)
        start = plan.start(job.seed, horizon_steps=env.spec.horizon_steps)
        noise = plan.recipe.action_noise
        acting: SimEnv = NoisyEnv(env, noise) if noise > 0 else env
        return attempt(acting, self._expert, start, plan.group.rollout, heartbeat=self._heartbeat)

    def _write_shard(self, job: ShardJob) -> Path:
        plan = job.plan
        env = self._make_env(dataclasses.replace(plan.group.env, cameras=tuple(CAMERA_KEYS)))
        arm = robot_of(plan.group.env.kwargs)
        size_px, max_frames = env.spec.cameras[0].height_px, env.spec.horizon_steps
        features = dataset_features(
            plan.recipe.state, action_names=env.spec.action.dims, image_size_px=size_px, arm=arm
        )
        encoder = plan.recipe.encoder
        writing = ShardWriter(job.path, features, encoder=encoder, max_frames=max_frames, robot=arm.name)
        with writing as writer:
            for index, one in enumerate(job.attempts, start=job.first_index):
                start = plan.start(one.seed, horizon_steps=one.n_steps)
                log = replay_attempt(env, start, one, heartbeat=self._heartbeat)
                self._heartbeat("setup")  # whose limit is long: encoding
                episode = recorded_episode(plan, one, log, index=index)
                writer.add_episode(episode, frames_of(plan.recipe, episode, log))
        return job.path


def join_dataset(job: JoinJob) -> DatasetFacts:
    """Put the shards of a task together; the dataset appears whole."""
    home = job.shards[0].parent / job.path.name
    remove_drafts(home)
    draft = draft_path(home)
    episodes = join_shards(job.shards, draft, RecordedEpisode)
    (draft / MIKASA_FOLDER).mkdir()
    write_lines(draft / MANIFEST_FILE, episodes)
    write_lines(draft / FAILED_FILE, job.failed)
    facts = dataclasses.replace(
        job.facts,
        n_episodes=len(episodes),
        n_frames=sum(episode.n_steps for episode in episodes),
        files=digest_files(draft),
    )
    write_entry(draft / RECORDING_FILE, facts)
    publish(draft, job.path)
    return facts


def recorded_episode(plan: TaskPlan, one: Attempt, log: EpisodeLog, *, index: int) -> RecordedEpisode:
    """Return the manifest's entry of an attempt that has been rendered, with the words of its episode."""
    start = plan.start(one.seed, horizon_steps=one.n_steps).worded(log.results[0].wording)
    return RecordedEpisode(
        episode_index=index,
        task=plan.task,
        task_version=plan.task_version,
        env_kwargs=without_path(plan.group.env.kwargs),
        instruction=start.instruction,
        expert=plan.group.key.policy,
        expert_version=plan.expert_version,
        **dataclasses.asdict(one),
        images_sha256=images_digests([result.observation.images for result in log.results[:-1]]),
    )


def frames_of(
    recipe: DatasetRecipe, episode: RecordedEpisode, log: EpisodeLog
) -> Sequence[dict[str, object]]:
    """Return the frames of an episode, as `ShardWriter.add_episode` takes them."""
    actions, arm = stored_actions(recipe, episode), robot_of(recipe.env)
    return [
        frame_values(
            before, after, action=action, state=recipe.state, is_last=step == episode.n_steps, arm=arm
        )
        for step, (before, after, action) in enumerate(
            zip(log.results[:-1], log.results[1:], actions, strict=True), start=1
        )
    ]


def stored_actions(recipe: DatasetRecipe, episode: RecordedEpisode) -> FloatArray:
    """Return the actions of the field `action`: the executed ones, or those without noise."""
    intended = episode.intended_rows()
    return intended if recipe.stored_action == "intended" and intended is not None else episode.action_rows()
