"""Decide which episodes a worker captures, and write their videos and rerun files when they are over."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.evaluation import CaptureConfig, is_wanted, may_be_wanted
from vla_eval.core import EpisodeStart, Stage
from vla_eval.records import EpisodeRecord
from vla_eval.specs import EnvSpec
from vla_eval.storage.capture_files import rrd_file, stills_file, strip_file, thumbnail_file, video_file
from vla_eval.viz.tape import EpisodeTape, Tapes


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeCapture:
    """What a worker captures, and into which run folder; `seed_start` is the first seed of each run."""

    config: CaptureConfig
    folder: Path
    seed_start: int

    def load(self) -> None:
        """Import the writers while the worker is being set up: it takes seconds."""
        config = self.config
        writers = ((config.video, "video"), (config.rrd, "rerun_log"), (config.strip, "strip"))
        for which, writer in writers:
            if which != "none":
                importlib.import_module(f"vla_eval.viz.{writer}")

    def tapes(self, starts: Sequence[EpisodeStart], *, with_images: bool) -> Tapes | None:
        """Return the observer of a batch; None if no episode of it can be captured."""
        slots = {
            start.slot
            for start in starts
            if any(
                may_be_wanted(which, run=start.run, index=start.seed - self.seed_start)
                for which in (self.config.video, self.config.rrd, self.config.strip)
            )
        }
        stride = self.config.frame_stride
        return Tapes(slots, frame_stride=stride, with_images=with_images) if slots else None

    def write(
        self,
        starts: Sequence[EpisodeStart],
        tapes: Tapes,
        records: Sequence[EpisodeRecord],
        *,
        env: EnvSpec,
        chunking: ChunkingSpec,
        heartbeat: Callable[[Stage], None],
        film: Callable[[EpisodeTape], EpisodeTape],
    ) -> None:
        """Write the captures of a finished batch; `film` renders those that have no images yet."""
        for start, record in zip(starts, records, strict=True):
            tape = tapes.episodes.get(start.slot)
            index, is_success = record.seed - self.seed_start, record.outcome == "success"
            for_video, for_rrd, for_strip = (
                is_wanted(which, run=record.run, index=index, is_success=is_success)
                for which in (self.config.video, self.config.rrd, self.config.strip)
            )
            if tape is None:
                continue
            if for_strip:
                from vla_eval.viz.strip import write_strip

                heartbeat("step")
                write_strip(tape, record, strip_file(self.folder, record), env=env, chunking=chunking)
            if not (for_video or for_rrd):
                continue
            tape = film(tape)
            if for_video:
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
            if for_rrd:
                from vla_eval.viz.rerun_log import write_rrd

                heartbeat("step")
                write_rrd(tape, record, rrd_file(self.folder, record), env=env)
