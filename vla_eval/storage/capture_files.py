"""What the files of an episode that was captured are called: video, rerun file, strip, memory, frames."""

from pathlib import Path

from vla_eval.records import EpisodeRecord
from vla_eval.storage.folders import FRAMES, MEMORIES, RRDS, STRIPS, VIDEOS


def capture_stem(record: EpisodeRecord) -> str:
    """Return `RememberColor3-v0_oracle_K1_run0_seed7_success`."""
    task = record.task.replace("/", "_")  # ids of official tasks have a namespace
    return (
        f"{task}_{record.policy}_K{record.n_action_steps}_run{record.run}_seed{record.seed}_{record.outcome}"
    )


def video_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the video of an episode is, or would be."""
    return folder / VIDEOS / f"{capture_stem(record)}.mp4"


def thumbnail_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the image of an episode's cue and its choice is, or would be."""
    return folder / VIDEOS / f"{capture_stem(record)}.jpg"


def stills_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the stills of an episode (cue, reveal, touch) are, or would be."""
    return folder / VIDEOS / f"{capture_stem(record)}_stills.jpg"


def rrd_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the rerun file of an episode is, or would be."""
    return folder / RRDS / f"{capture_stem(record)}.rrd"


def strip_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the drawing of how an episode was executed is, or would be."""
    return folder / STRIPS / f"{capture_stem(record)}.svg"


def memory_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the file of what a policy remembered in an episode is, or would be."""
    return folder / MEMORIES / f"{capture_stem(record)}.npz"


def frames_file(folder: Path, record: EpisodeRecord) -> Path:
    """Return where the file of an episode's small frames is, or would be."""
    return folder / FRAMES / f"{capture_stem(record)}.npz"
