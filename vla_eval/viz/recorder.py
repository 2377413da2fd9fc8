"""Decide which episodes a worker records, and write them when they are over."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_eval.plan import EpisodeJob
from vla_eval.results.recording_files import rrd_file, thumbnail_file, video_file
from vla_eval.results.records import EpisodeRecord
from vla_eval.viz.settings import RecordingConfig, is_wanted, may_be_wanted
from vla_eval.viz.tape import Tapes


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorder:
    """What a worker is told of recording.

    Attributes:
        config: what is recorded.
        folder: the run folder.
        seed_start: the first seed of each run.
    """

    config: RecordingConfig
    folder: Path
    seed_start: int

    def tapes(self, jobs: Sequence[EpisodeJob]) -> Tapes | None:
        """Return the observer of a batch; None if none of its episodes can be wanted."""
        slots = {
            job.slot
            for job in jobs
            if any(
                may_be_wanted(which, run=job.run, index=job.seed - self.seed_start)
                for which in (self.config.video, self.config.rrd)
            )
        }
        return Tapes(slots, frame_stride=self.config.frame_stride) if slots else None

    def write(
        self, jobs: Sequence[EpisodeJob], tapes: Tapes, records: Sequence[EpisodeRecord], control_hz: float
    ) -> None:
        """Write what is wanted of a batch that is over.

        Args:
            jobs: the batch.
            tapes: what was seen of it.
            records: what came of it, in the order of the jobs.
            control_hz: control steps per second.

        Raises:
            ViewingError: a file could not be written.
        """
        for job, record in zip(jobs, records, strict=True):
            tape = tapes.episodes.get(job.slot)
            if tape is None:
                continue
            if self._wants(self.config.video, job, record):
                rate_hz = control_hz / self.config.frame_stride
                names = {
                    "path": video_file(self.folder, record),
                    "thumbnail": thumbnail_file(self.folder, record),
                }
                _writer("video", "write_video")(tape, record, **names, frame_rate_hz=rate_hz)
            if self._wants(self.config.rrd, job, record):
                _writer("rerun_log", "write_rrd")(
                    tape, record, rrd_file(self.folder, record), control_hz=control_hz
                )

    def _wants(self, which: Any, job: EpisodeJob, record: EpisodeRecord) -> bool:
        index = job.seed - self.seed_start
        return is_wanted(which, run=job.run, index=index, is_success=record.outcome == "success")


def _writer(module: str, function: str) -> Any:  # Any: the two take different arguments
    # When it is needed: a worker that records no rrd need not wait for rerun's import.
    return getattr(importlib.import_module(f"vla_eval.viz.{module}"), function)
