"""Write an `.rrd` file atomically, and its two timelines."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from vla_eval.errors import ViewingError

APPLICATION = "mikasa-vla"


@contextlib.contextmanager
def rrd_when_whole(
    path: Path, *, recording_id: str, blueprint: rrb.Blueprint, failed: str, advice: str
) -> Iterator[rr.RecordingStream]:
    """Give a stream to log to. The file gets its name once everything is in it.

    Raises:
        ViewingError: the file cannot be written; `failed` is the message before the cause, `advice` after it.
    """
    unfinished = path.with_suffix(".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.touch()  # rerun itself reports no error where it cannot write
        with rr.RecordingStream(APPLICATION, recording_id=recording_id) as stream:
            stream.save(str(unfinished), default_blueprint=blueprint)
            yield stream
            stream.flush()
            stream.disconnect()
        unfinished.replace(path)
    except (OSError, RuntimeError, ValueError) as exc:
        raise ViewingError(f"{path}: {failed} ({exc}). {advice}") from exc


def set_step(stream: rr.RecordingStream, step: int, control_hz: float) -> None:
    """Set the control step of what is logged next."""
    stream.set_time("step", sequence=step)
    stream.set_time("time", duration=step / control_hz)


def time_columns(steps: NDArray[np.int64], control_hz: float) -> list[rr.TimeColumn]:
    """Return both timelines of so many control steps."""
    return [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("time", duration=steps / control_hz)]


def send_curve(
    stream: rr.RecordingStream,
    entity: str,
    steps: NDArray[np.int64],
    values: NDArray[np.floating],
    control_hz: float,
) -> None:
    """Log one number per step."""
    stream.send_columns(
        entity,
        indexes=time_columns(steps, control_hz),
        columns=rr.Scalars.columns(scalars=values.astype(np.float64)),
    )
