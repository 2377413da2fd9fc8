"""Write an `.rrd` file atomically, its two timelines, and its layout in the rerun viewer."""

import contextlib
from collections.abc import Iterator, Sequence
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
    """Give a stream to log to; the file gets its name once everything is in it."""
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


def layout(
    cameras: Sequence[str], action_dims: Sequence[str], state_dims: Sequence[str] = ()
) -> rrb.Blueprint:
    """Return the blueprint: the world and the cameras with images above, curves and words below."""
    views = [rrb.Spatial2DView(origin=f"cameras/{name}", name=name) for name in cameras]
    above = rrb.Horizontal(
        rrb.Spatial3DView(origin="world", name="world"),
        *([rrb.Grid(*views)] if views else []),
        rrb.Vertical(
            rrb.TextDocumentView(origin="instruction", name="instruction"),
            rrb.TextLogView(origin="events", name="events"),
            row_shares=[1, 2],
        ),
        column_shares=[3, *([3] if views else []), 2],
    )
    curves = rrb.Tabs(
        *(rrb.TimeSeriesView(origin=f"actions/{name}", name=name) for name in action_dims),
        *([rrb.TimeSeriesView(origin="state", name="state")] if state_dims else []),
        name="actions",
    )
    states = rrb.Vertical(
        rrb.TimeSeriesView(origin="phase", name="phase"),
        rrb.TimeSeriesView(
            origin="/", contents=["/gripper/**", "/reward", "/success", "/choice/**"], name="gripper, reward"
        ),
    )
    below = rrb.Horizontal(curves, states, column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[3, 2]),
        rrb.TimePanel(timeline="step", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


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
