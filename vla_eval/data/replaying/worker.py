"""The inside of a worker that replays: executes an episode's actions and compares the result."""

from collections.abc import Callable

from vla_eval.core import ImageArray
from vla_eval.data.manifest import RecordedEpisode
from vla_eval.data.opening import LocalDataset, read_sample
from vla_eval.data.recording.demonstrations import replay_actions
from vla_eval.data.replaying.episode_check import MIN_PSNR_DB, check_pictures, check_rows, check_states
from vla_eval.data.replaying.replay import EpisodeReplayed, ReplayJob
from vla_eval.data.simulator_runner import SimulatorRunner
from vla_eval.data.tables import rows_of_episode
from vla_eval.features import CAMERA_KEYS
from vla_eval.workers.inside import Heartbeat
from vla_eval.workers.messages import DeviceFound


class ReplayRunner(SimulatorRunner[ReplayJob, EpisodeReplayed]):
    """Replays episodes; keeps the dataset, too."""

    def __init__(self, heartbeat: Heartbeat, tell: Callable[[DeviceFound], None]) -> None:
        super().__init__(heartbeat, tell)
        self._dataset: LocalDataset | None = None

    def _do(self, job: ReplayJob) -> EpisodeReplayed:
        episode = job.episode
        env = self._make_env(job.env)
        if self._dataset is None or self._dataset.root != job.dataset:
            self._dataset = LocalDataset(job.dataset)
        dataset = self._dataset
        log = replay_actions(
            env, episode.start(), episode.action_rows(), heartbeat=self._heartbeat, with_pictures=job.pixels
        )
        self._heartbeat("setup")
        rows = rows_of_episode(dataset.columns, episode.episode_index)
        mismatches = [
            *check_rows(episode, rows, log),
            *check_states(episode, rows, log, expect_equal_bits=job.same_machine),
        ]
        quality: dict[str, float] = {}
        if job.pixels and not mismatches:
            pictures = check_pictures(
                episode,
                [result.observation.images for result in log.results[:-1]],
                _decode(dataset, episode),
                expect_equal_bits=job.same_machine and self._device == job.device,
                min_psnr_db=MIN_PSNR_DB[job.env.simulator],
            )
            mismatches += pictures.mismatches
            quality = pictures.psnr_db
        return EpisodeReplayed(
            episode_index=episode.episode_index, mismatches=tuple(mismatches), psnr_db=quality
        )


def _decode(dataset: LocalDataset, episode: RecordedEpisode) -> dict[str, list[ImageArray]]:
    """Return camera -> frames of the episode's video, (H, W, 3) uint8."""
    videos = dataset.in_bytes
    first = int(videos.meta.episodes[episode.episode_index]["dataset_from_index"])
    items = [read_sample(videos, first + step) for step in range(episode.n_steps)]
    return {
        camera: [item[key].permute(1, 2, 0).numpy() for item in items] for camera, key in CAMERA_KEYS.items()
    }
