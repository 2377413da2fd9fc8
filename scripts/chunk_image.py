"""Draw `docs/images/chunk_sizes.png`: success and steps until it, over K, of a run that `eval` has made.

python scripts/chunk_image.py runs/chunks docs/images/chunk_sizes.png
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from vla_eval.results.own_statistics import STEPS, SUCCESS
from vla_eval.results.relative_statistics import CHANCE
from vla_eval.results.report import Row, build_table
from vla_eval.storage.run_folder import read_run

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito, without yellow
WIDTH_IN, HEIGHT_IN, DPI = 9.0, 3.4, 150
DODGE = 0.1  # of the distance between two K, so that intervals stand beside each other


def main() -> None:
    """Read the run, draw, save."""
    source, target = map(Path, sys.argv[1:])
    rows = build_table([read_run(source)]).rows
    policies = list(dict.fromkeys(row.policy for row in rows))
    sizes = sorted({row.n_action_steps for row in rows})
    figure, (left, right) = plt.subplots(1, 2, figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
    for number, policy in enumerate(policies):
        own = [row for row in rows if row.policy == policy]
        offset = DODGE * (number - (len(policies) - 1) / 2)
        places = [sizes.index(row.n_action_steps) + offset for row in own]
        style = {"color": COLORS[number % len(COLORS)], "marker": "osD^v"[number % 5], "label": policy}
        left.errorbar(places, [_rate(row) for row in own], yerr=_errors(own), capsize=3, **style)
        steps = [(x, row[STEPS]) for x, row in zip(places, own, strict=True)]
        known = [(x, value) for x, value in steps if value is not None]
        right.plot([x for x, _ in known], [value for _, value in known], **style)
    if (chance := rows[0][CHANCE]) is not None:
        left.axhline(chance.rate, color="0.5", linestyle="--", linewidth=1)
    left.set(ylabel="success once", ylim=(0, 1.05))
    right.set(ylabel="control steps until success", ylim=(0, None))
    for axes in (left, right):
        axes.set(xlabel="K (n_action_steps)", xticks=range(len(sizes)), xticklabels=map(str, sizes))
    right.legend(frameon=False, fontsize=8)
    figure.savefig(target, dpi=DPI)


def _rate(row: Row) -> float:
    rate = row[SUCCESS].success_once
    assert rate is not None  # every row of the figure has results
    return rate


def _errors(rows: list[Row]) -> list[list[float]]:
    pairs = [(row[SUCCESS].ci_low, row[SUCCESS].ci_high, _rate(row)) for row in rows]
    return [
        [rate - low for low, _, rate in pairs if low is not None],
        [high - rate for _, high, rate in pairs if high is not None],
    ]


if __name__ == "__main__":
    main()
