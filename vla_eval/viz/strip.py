"""Draw how an episode was executed: commands, the arm's way, borders of chunks, held steps; an SVG file."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.episode_log import TCP_POSE
from vla_eval.latency import DelayTrace, EpisodeDelays, VaryingDelay
from vla_eval.motion import HELD
from vla_eval.records import EpisodeRecord
from vla_eval.specs import EnvSpec
from vla_eval.storage.durable import replace_file
from vla_eval.viz.tape import EpisodeTape

WIDTH_IN, PANEL_IN = 9.0, 1.7
INK, RULE, HELD_COLOR = "#1b1d21", "#d9dce1", "#e69f00"
LINES = ("#0072b2", "#d55e00", "#009e73")
Values = NDArray[Any]  # Any: numbers of any type
_STYLE = {"svg.hashsalt": "vla_eval", "text.parse_math": False, "font.size": 9}


def write_strip(
    tape: EpisodeTape, record: EpisodeRecord, path: Path, *, env: EnvSpec, chunking: ChunkingSpec
) -> None:
    """Draw an episode; the same episode gives the same bytes."""
    sources = sources_of(tape, record, chunking)
    names = env.action.dims[:3]
    actions = np.array([step.action[:3] for step in tape.steps[1:] if step.action is not None])
    path_m = [step.result.observation.state.get(TCP_POSE) for step in tape.steps]
    positions = [pose[:3] for pose in path_m if pose is not None]
    with matplotlib.style.context(_STYLE, after_reset=True):
        n_panels = 2 if positions else 1
        figure = Figure(
            figsize=(WIDTH_IN, PANEL_IN * n_panels + 0.6), facecolor="white", layout="constrained"
        )
        panels = figure.subplots(n_panels, 1, sharex=True, squeeze=False)[:, 0]
        _draw(panels[0], np.arange(len(actions)) + 0.5, actions, names, title="command")
        if positions:
            way_mm = 1000 * (np.array(positions) - positions[0])
            _draw(panels[1], np.arange(len(way_mm)), way_mm, ("x", "y", "z"), title="way of the gripper, mm")
        for panel in panels:
            _mark(panel, sources)
        panels[-1].set_xlabel("control step")
        figure.suptitle(_title(record, chunking), x=0.01, ha="left", fontsize=9)
        drawn = io.StringIO()
        figure.savefig(drawn, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    path.parent.mkdir(exist_ok=True)
    replace_file(path, drawn.getvalue())


def sources_of(tape: EpisodeTape, record: EpisodeRecord, chunking: ChunkingSpec) -> list[int]:
    """Return of each control step the step of the inference behind its action, or `HELD`.

    Chunks are executed once more as they were, with the delays of the record.
    """
    delay, trace = chunking.delay, None
    if record.delay_steps is not None:
        delay = VaryingDelay(trace="record")
        trace = DelayTrace(episodes={(record.run, record.seed): record.delay_steps}, pool=())
    delays = EpisodeDelays(delay=delay, seed=record.seed, run=record.run, control_hz=1.0, trace=trace)
    executor, chunks = ChunkExecutor(chunking, delays), {one.step: one.chunk for one in tape.chunks}
    sources = []
    for step in range(len(tape.steps) - 1):
        if step in chunks:
            executor.submit(step, chunks[step], seconds=0.0)
        executed = executor.action(step)
        sources.append(HELD if executed is None else executed.inferred_at_step)
    return sources


def _draw(axes: Axes, at: Values, values: Values, names: Sequence[str], *, title: str) -> None:
    for values_of, name, color in zip(values.T, names, LINES, strict=True):
        axes.plot(at, values_of, color=color, linewidth=1.2, label=name)
    axes.set_title(title, loc="left", fontsize=9, color=INK)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=3, fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)


def _mark(axes: Axes, sources: Sequence[int]) -> None:
    for step, source in enumerate(sources):
        if source == HELD:
            axes.axvspan(step, step + 1, color=HELD_COLOR, alpha=0.35, linewidth=0)
        elif step and source != sources[step - 1]:
            axes.axvline(step, color=RULE, linewidth=1, zorder=0)
    axes.set_xlim(0, len(sources))


def _title(record: EpisodeRecord, chunking: ChunkingSpec) -> str:
    delay = "delays of its own" if record.delay_steps is not None else f"delay {chunking.delay}"
    return (
        f"{record.task}, {record.policy}, seed {record.seed}: {record.outcome}\n"
        f"K = {record.n_action_steps}, {chunking.mode}, {delay}. Lines: a new chunk; orange: held"
    )
