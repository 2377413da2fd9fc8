"""Decide which episodes a worker captures, and write their videos and rerun files when they are over."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from vla_eval.config.capture import CaptureConfig, is_wanted, may_be_wanted
from vla_eval.core import Stage
from vla_eval.records import EpisodeRecord
from vla_eval.specs import EnvSpec
from vla_eval.storage.capture_files import rrd_file, stills_file, thumbnail_file, video_file
from vla_eval.viz.tape import Tapes


class Capturable(Protocol):
    """The facts of an episode that decide whether it is captured."""

    @property
    def slot(self) -> int:
        """The slot it runs in."""

    @property
    def run(self) -> int:
        """Its run."""

    @property
    def seed(self) -> int:
        """Its seed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeCapture:
    """What a worker captures, and where to.

    Attributes:
        config: what is captured.
        folder: the run folder.
        seed_start: the first seed of each run.
    """

    config: CaptureConfig
    folder: Path
    seed_start: int

    def load(self) -> None:
        """Import the writers while the worker is being set up: it takes seconds."""
        for which, writer in ((self.config.video, "video"), (self.config.rrd, "rerun_log")):
            if which != "none":
                importlib.import_module(f"vla_eval.viz.{writer}")

    def tapes(self, jobs: Sequence[Capturable]) -> Tapes | None:
        """Return the observer of a batch; None if no episode of it can be captured."""
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
        self,
        jobs: Sequence[Capturable],
        tapes: Tapes,
        records: Sequence[EpisodeRecord],
        *,
        env: EnvSpec,
        heartbeat: Callable[[Stage], None],
    ) -> None:
        """Write the captures of a finished batch.

        Args:
            jobs: the batch.
            tapes: the tapes of its episodes.
            records: its results, in the order of the jobs.
            env: what the environment offers.
            heartbeat: called before each file: the watchdog gives each the time of a step.

        Raises:
            ViewingError: a file could not be written.
        """
        for job, record in zip(jobs, records, strict=True):
            tape = tapes.episodes.get(job.slot)
            if tape is None:
                continue
            if self._wants(self.config.video, job, record):
                # Here and not above: a worker that writes no video need not wait for the encoder.
                from vla_eval.viz.video import write_video

                heartbeat("step")
                write_video(
                    tape,
                    record,
                    video_file(self.folder, record),
                    thumbnail=thumbnail_file(self.folder, record),
                    stills=stills_file(self.folder, record),
                    frame_rate_hz=env.control_hz / self.config.frame_stride,
                )
            if self._wants(self.config.rrd, job, record):
                from vla_eval.viz.rerun_log import write_rrd

                heartbeat("step")
                write_rrd(tape, record, rrd_file(self.folder, record), env=env)

    def _wants(self, which: Any, job: Capturable, record: EpisodeRecord) -> bool:
        index = job.seed - self.seed_start
        return is_wanted(which, run=job.run, index=index, is_success=record.outcome == "success")
