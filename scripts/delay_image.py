"""Draw `docs/images/real_time.png`: success over the delay of an inference, of runs that `eval` has made.

python scripts/delay_image.py docs/images/real_time.png runs/delays/*
"""

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any  # of matplotlib

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import MaxNLocator

from vla_eval.results.own_statistics import SUCCESS
from vla_eval.results.report import Row, build_table
from vla_eval.storage.run_folder import read_run

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")  # Okabe and Ito
ENSEMBLE = "temporal_ensemble"  # another execution without a delay, too
EXECUTIONS: dict[str, tuple[Any, str]] = {
    "skip": (":", "x"),
    "stale": ("-", "o"),
    "wait": ("--", "s"),
    "prefix": ("-.", "^"),
    ENSEMBLE: ((0, (6, 1, 1, 1, 1, 1)), "d"),
}
WIDTH_IN, HEIGHT_IN, LEGEND_IN, DPI = 4.5, 3.0, 1.5, 150
Cells = dict[tuple[int, str, str], dict[int, Row]]


def main() -> None:
    """Read the runs, draw, save."""
    target, *sources = map(Path, sys.argv[1:])
    cells = _read(sources)
    policies = list(dict.fromkeys(policy for _, policy, _ in cells))
    sizes = sorted({k for k, _, _ in cells})
    figure, panels = plt.subplots(
        1,
        len(sizes),
        figsize=(WIDTH_IN * len(sizes) + LEGEND_IN, HEIGHT_IN),
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    for axes, size in zip(panels[0], sizes, strict=True):
        for (k, policy, execution), rows in cells.items():
            if k == size:
                line, marker = EXECUTIONS[execution]
                color = COLORS[policies.index(policy)]
                delays = sorted(rows)
                axes.errorbar(
                    delays,
                    [rows[delay][SUCCESS].success_once for delay in delays],
                    yerr=_errors([rows[delay] for delay in delays]),
                    color=color,
                    linestyle=line,
                    marker=marker,
                    capsize=3,
                )
        axes.set(title=f"K = {size}", xlabel="delay (control steps)", ylim=(-0.05, 1.05))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0, 0].set(ylabel="success once")
    marks = [plt.Line2D([], [], color=COLORS[i], label=name) for i, name in enumerate(policies)]
    shown = [one for one in EXECUTIONS if any(execution == one for _, _, execution in cells)]
    marks += [
        plt.Line2D([], [], color="0.4", linestyle=EXECUTIONS[one][0], marker=EXECUTIONS[one][1], label=one)
        for one in shown
    ]
    figure.legend(handles=marks, loc="outside right center", frameon=False, fontsize=8)
    figure.savefig(target, dpi=DPI)


def _read(sources: list[Path]) -> Cells:
    """Return K, policy, execution -> delay -> row; without a delay, all others are one."""
    cells: Cells = defaultdict(dict)
    without: list[Row] = []
    for source in sources:
        run = read_run(source)
        chunking = run.description.config["chunking"]
        delay, mode = chunking.get("delay", chunking.get("delay_steps")), chunking["mode"]
        execution = chunking["delay_alignment"] if mode == "receding_horizon" else mode
        for row in build_table([run]).rows:
            if delay or execution == ENSEMBLE:
                cells[row.n_action_steps, row.policy, execution][delay or 0] = row
            else:
                without.append(row)
    for (k, policy, _), rows in cells.items():
        own = [row for row in without if (row.n_action_steps, row.policy) == (k, policy)]
        if own and 0 not in rows:
            rows[0] = own[0]
    return cells


def _errors(rows: list[Row]) -> list[list[float]]:
    found = [row[SUCCESS] for row in rows]
    return [
        [one.success_once - one.ci_low for one in found],
        [one.ci_high - one.success_once for one in found],
    ]


if __name__ == "__main__":
    main()
