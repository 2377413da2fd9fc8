"""Compare an episode that was done again with its record in a dataset: a sentence per mismatch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.config.environment import Simulator
from vla_eval.core import FloatArray, ImageArray
from vla_eval.data.manifest import RecordedEpisode
from vla_eval.data.recording.demonstrations import EpisodeLog, images_digests, states_digest
from vla_eval.data.tables import Columns
from vla_eval.features import ACTION_KEY, PROPRIO_KEYS, SUCCESS_KEY, proprioception, state_names
from vla_eval.robots.arm import Arm
from vla_eval.robots.find import robot_of

STATE_TOLERANCE = 1e-2  # m, rad, rad/s; for machines whose arithmetic differs in the last bits
MIN_PSNR_DB: dict[Simulator, float] = {
    "maniskill": 34.0,  # yuv444p at crf 12 gives 38 to 41 dB; yuv420p stays below 34 at any quality
    "fake": 25.0,  # its images are noise, which the codec keeps at 31 dB; a different image has 8 dB
}
MAX_LEVEL = 255.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageCheck:
    """What a comparison of images has found; `psnr_db` is that of the video, by camera."""

    mismatches: tuple[str, ...]
    psnr_db: dict[str, float]


def check_rows(episode: RecordedEpisode, rows: Columns, log: EpisodeLog) -> list[str]:
    """Compare the table's actions, states and successes with the manifest and with the fresh episode."""
    if len(rows[ACTION_KEY]) != episode.n_steps:
        return [f"the table has {len(rows[ACTION_KEY])} frames, the manifest {episode.n_steps}"]
    found = []
    known = (episode.action_rows(), episode.intended_rows())
    if not any(np.array_equal(rows[ACTION_KEY], actions) for actions in known if actions is not None):
        found.append("the actions of the table are not those of the manifest")
    successes = np.array([result.status.success for result in log.results[1:]])
    if not np.array_equal(rows[SUCCESS_KEY].reshape(-1), successes):
        found.append("next.success of the table is not what the simulator says")
    return found


def check_states(
    episode: RecordedEpisode, rows: Columns, log: EpisodeLog, *, expect_equal_bits: bool
) -> list[str]:
    """Compare states and success with the manifest; unless bits are compared, within `STATE_TOLERANCE`."""
    equal = states_digest(log.results) == episode.states_sha256
    found = []
    if not equal:
        difference = _largest_difference(rows, log, robot_of(episode.env_kwargs))
        if expect_equal_bits or difference.value > STATE_TOLERANCE:
            found.append(f"states differ, most by {difference.value:.2g} in {difference.where}")
    success_step = next((i for i, result in enumerate(log.results) if result.status.success and i > 0), None)
    if (success_step is None) != (episode.success_step is None) or (
        equal and success_step != episode.success_step
    ):
        found.append(f"first success at step {success_step}, expected at {episode.success_step}")
    return found


def check_pictures(
    episode: RecordedEpisode,
    frames: Sequence[Mapping[str, ImageArray]],
    decoded: Mapping[str, Sequence[ImageArray]],
    *,
    expect_equal_bits: bool,
    min_psnr_db: float,
) -> ImageCheck:
    """Compare rendered images, by step, with the manifest's digests, and the video, by camera, with both."""
    found = []
    fresh = images_digests(frames)
    if expect_equal_bits:
        found += [
            f"{camera}: the raw images differ from the recorded ones"
            for camera, digest in episode.images_sha256.items()
            if fresh.get(camera) != digest
        ]
    quality = {
        camera: psnr_db(np.stack([frame[camera] for frame in frames]), np.stack(list(decoded[camera])))
        for camera in episode.images_sha256
    }
    found += [
        f"{camera}: the video is {decibels:.1f} dB from the rendered frames, expected ≥ {min_psnr_db:g} dB"
        for camera, decibels in quality.items()
        if decibels < min_psnr_db
    ]
    return ImageCheck(mismatches=tuple(found), psnr_db=quality)


def psnr_db(reference: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Return the peak signal-to-noise ratio of 8-bit images of one shape; 100 for equal ones."""
    error = reference.astype(np.float64) - other.astype(np.float64)
    mean_square = float((error**2).mean())
    return 100.0 if mean_square == 0 else float(10 * np.log10(MAX_LEVEL**2 / mean_square))


class _Difference(NamedTuple):
    value: float
    where: str


def _largest_difference(rows: Columns, log: EpisodeLog, arm: Arm) -> _Difference:
    fresh: FloatArray = np.stack(
        [proprioception(r.observation.state, arm)["joints"] for r in log.results[:-1]]
    )
    stored = rows[PROPRIO_KEYS["joints"]].astype(np.float32)
    if stored.shape != fresh.shape:
        return _Difference(float("inf"), f"length at step {min(len(stored), len(fresh))}")
    gap = np.abs(stored - fresh)
    step, dim = (int(i) for i in np.unravel_index(int(gap.argmax()), gap.shape))
    return _Difference(float(gap[step, dim]), f"{state_names(arm)['joints'][dim]} at step {step}")
