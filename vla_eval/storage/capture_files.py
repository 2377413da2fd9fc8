"""The files of an episode that was captured, a row each, and what they are called."""

from dataclasses import dataclass
from pathlib import Path

from vla_eval.records import EpisodeRecord


@dataclass(frozen=True, slots=True)
class EpisodeFile:
    """One kind of file: the folder of a run folder that it is in, and how its name ends."""

    folder: str
    ending: str

    def __call__(self, run: Path, record: EpisodeRecord) -> Path:
        """Return where the file of an episode is, or would be, in a run folder."""
        return run / self.folder / f"{capture_stem(record)}{self.ending}"


video_file = EpisodeFile("videos", ".mp4")
thumbnail_file = EpisodeFile("videos", ".jpg")  # the cue and the choice
stills_file = EpisodeFile("videos", "_stills.jpg")  # cue, reveal, touch
rrd_file = EpisodeFile("rrd", ".rrd")  # for the rerun viewer
strip_file = EpisodeFile("strips", ".svg")  # a drawing of how it was executed
memory_file = EpisodeFile("memories", ".npz")  # what the policy remembered
frames_file = EpisodeFile("frames", ".npz")  # small frames until the response

EPISODE_FILES = (video_file, thumbnail_file, stills_file, rrd_file, strip_file, memory_file, frames_file)


def capture_stem(record: EpisodeRecord) -> str:
    """Return `RememberColor3-v0_oracle_K1_run0_seed7_success`."""
    task = record.task.replace("/", "_")  # ids of official tasks have a namespace
    return (
        f"{task}_{record.policy}_K{record.n_action_steps}_run{record.run}_seed{record.seed}_{record.outcome}"
    )
