"""The inside of a worker that replays: executes an episode's actions and compares the result."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any  # lerobot is untyped

from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, ImageArray, SimEnv
from vla_eval.data.manifest import RecordedEpisode
from vla_eval.data.opening import open_local_dataset, read_sample
from vla_eval.data.recording.demonstrations import SLOT, replay_actions
from vla_eval.data.replaying.episode_check import MIN_PSNR_DB, check_pictures, check_rows, check_states
from vla_eval.data.replaying.replay import EpisodeReplayed, ReplayJob
from vla_eval.data.tables import Columns, read_columns, rows_of_episode
from vla_eval.envs.factory import describe_device, make_env
from vla_eval.errors import VlaEvalError
from vla_eval.features import CAMERA_KEYS
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import DeviceFound, Failed, describe_error

logger = logging.getLogger(__name__)


class ReplayRunner:
    """Replays episodes, keeping environment and dataset between those that need the same."""

    def __init__(self, heartbeat: Heartbeat, tell: Callable[[DeviceFound], None]) -> None:
        """Start with nothing made."""
        self._heartbeat = heartbeat
        self._tell = tell
        self._env: SimEnv | None = None
        self._env_settings: EnvSettings | None = None
        self._device: dict[str, str] = {}
        self._root: Path | None = None
        self._columns: Columns = {}
        self._videos: Any = None  # Any: lerobot is untyped

    def answer(self, job: ReplayJob) -> EpisodeReplayed | Failed:
        """Replay the episode; whatever goes wrong becomes a `Failed`."""
        self._heartbeat.begin_batch()
        self._heartbeat("setup")
        try:
            return self._replay(job)
        except BaseException as exc:  # as in every worker: nothing ends it unseen
            logger.exception("%s, episode %d", job.dataset, job.episode.episode_index)
            return Failed(
                error=describe_error(exc, self._heartbeat.stage), refused=isinstance(exc, VlaEvalError)
            )

    def close(self) -> None:
        """Release the simulator."""
        if self._env is not None:
            self._env.close()
        self._env = self._env_settings = None

    def _replay(self, job: ReplayJob) -> EpisodeReplayed:
        episode = job.episode
        env = self._make_env(job.env)
        self._open(job)
        start = EpisodeStart(
            slot=SLOT,
            task=episode.task,
            seed=episode.seed,
            run=0,
            instruction=episode.instruction,
            horizon_steps=episode.n_steps,
        )
        log = replay_actions(
            env, start, episode.action_rows(), heartbeat=self._heartbeat, with_pictures=job.pixels
        )
        self._heartbeat("setup")
        rows = rows_of_episode(self._columns, episode.episode_index)
        mismatches = [
            *check_rows(episode, rows, log),
            *check_states(episode, rows, log, expect_equal_bits=job.same_machine),
        ]
        quality: dict[str, float] = {}
        if job.pixels and not mismatches:
            pictures = check_pictures(
                episode,
                [result.observation.images for result in log.results[:-1]],
                self._decode(episode),
                expect_equal_bits=job.same_machine and self._device == job.device,
                min_psnr_db=MIN_PSNR_DB[job.env.simulator],
            )
            mismatches += pictures.mismatches
            quality = pictures.psnr_db
        return EpisodeReplayed(
            episode_index=episode.episode_index, mismatches=tuple(mismatches), psnr_db=quality
        )

    def _decode(self, episode: RecordedEpisode) -> dict[str, list[ImageArray]]:
        """Return camera -> frames of the episode's video, (H, W, 3) uint8."""
        first = int(self._videos.meta.episodes[episode.episode_index]["dataset_from_index"])
        items = [read_sample(self._videos, first + step) for step in range(episode.n_steps)]
        return {
            camera: [item[key].permute(1, 2, 0).numpy() for item in items]
            for camera, key in CAMERA_KEYS.items()
        }

    def _open(self, job: ReplayJob) -> None:
        if self._root == job.dataset:
            return
        self._columns = read_columns(job.dataset)
        self._videos = open_local_dataset(job.dataset, return_uint8=True) if job.pixels else None
        self._root = job.dataset

    def _make_env(self, settings: EnvSettings) -> SimEnv:
        if self._env is None or self._env_settings != settings:
            self.close()
            self._env = make_env(settings)
            self._env_settings = settings
            self._device = dict(describe_device(self._env) or {})
        return self._env
