"""The curve of a training as `curve.png`: what it had while it learned, and on held-out seeds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.tasks.catalog import task_spec
from vla_eval.training.held_out import METRIC_KEY

CURVE_FILE = "curve.png"
MAX_POINTS = 200  # of the training's own episodes: each is the mean of as many updates as needed
LOSS, RETURN, SUCCESS = "loss", "episode_return", "success"
TITLES = {LOSS: "loss on the demonstrations", RETURN: "return of an episode", SUCCESS: "success_once"}


def draw_curve(
    out: Path, lines: Sequence[Mapping[str, Any]], *, name: str, task: str, imitates: bool
) -> None:
    """Draw the lines of metrics; nothing, if there is nothing yet.

    `imitates`: the training has a loss, and no episodes of its own.
    """
    own = LOSS if imitates else RETURN
    trained = [line for line in lines if own in line and METRIC_KEY not in line]
    held_out = [line for line in lines if METRIC_KEY in line]
    if not trained:
        return
    # Without pyplot, whose state is the whole process's.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, MaxNLocator

    keys = [own]
    if imitates and any("mean_return" in line for line in held_out):
        keys.append(RETURN)
    if any(line.get(SUCCESS) or "success_once" in line for line in lines):
        keys.append(SUCCESS)
    figure = Figure(figsize=(4.6 * len(keys), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, key in zip(np.atleast_1d(figure.subplots(1, len(keys))), keys, strict=True):
        if any(key in line for line in trained):
            steps, values = _thinned([line for line in trained if key in line], key)
            label = "training" if imitates else "training, exploring"
            axes.plot(steps, values, color="#1f77b4", linewidth=1.2, label=label)
        if key != LOSS:
            _held_out_points(axes, held_out, key)
        chance = task_spec(task).chance_success
        if key == SUCCESS and chance is not None:
            axes.axhline(chance, color="#888888", linestyle=":", label=f"chance {chance:.2f}")
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_xlabel("gradient steps" if imitates else "control steps of all environments")
        axes.set_ylabel(TITLES[key])
        axes.legend(fontsize=7)
        if key == SUCCESS:
            axes.set_ylim(-0.03, 1.03)
    figure.suptitle(f"{name} on {task}", fontsize=10)
    figure.savefig(out / CURVE_FILE, dpi=130)


def _thinned(lines: Sequence[Mapping[str, Any]], key: str) -> tuple[list[float], list[float]]:
    parts = np.array_split(np.arange(len(lines)), min(len(lines), MAX_POINTS))
    steps = [float(lines[part[-1]]["step"]) for part in parts]
    return steps, [float(np.mean([lines[i][key] for i in part])) for part in parts]


def _held_out_points(axes: Any, lines: Sequence[Mapping[str, Any]], key: str) -> None:
    names = ("success_once", "success_low", "success_high")
    if key == RETURN:
        names = ("mean_return", "return_low", "return_high")
    points = [line for line in lines if names[0] in line]
    if not points:
        return
    values = np.array([[line[name] for name in names] for line in points])
    errors = np.abs(values[:, 1:] - values[:, :1]).T
    axes.errorbar(
        [line["step"] for line in points],
        values[:, 0],
        yerr=errors,
        fmt="o",
        markersize=4,
        capsize=2,
        color="#d62728",
        label="held-out seeds, 95 %",
    )
