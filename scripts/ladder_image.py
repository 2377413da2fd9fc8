"""Draw whether a memory core's rank on diagnostic tasks is that on robot tasks, and print tables of both.

python scripts/ladder_image.py docs/images/ladder.png runs/ladder_base/evaluation …

A score is the part of the way from the best player without memory (0) to the oracle (1), on the same seeds.
Scores are kept beside the image, as ladder.csv: what is given replaces what is kept of its tasks, so that a
task can be added without the others being trained again.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from scipy.stats import norm, permutation_test, spearmanr

from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec

WITHOUT, WITH, WITHOUT_MEMORY = ("memoryless", "cue_blind"), "oracle", "mlp"
CONTROLS = {*WITHOUT, WITH, "random"}
ENDS = ("diagnostic", "robot")
TYPES = ("object", "sequential", "capacity")
IN_ORDER = "sequential"  # the robot tasks of this type ask for an order
MINUS = "\N{MINUS SIGN}"
SIZE_IN, DPI = 3.1, 150
MARKERS = "osD^v<>Ph"  # many points lie on each other
Scores = dict[str, dict[str, float]]  # core -> task -> score


def main() -> None:
    """Read the evaluations, keep, print, draw."""
    target, *folders = sys.argv[1:]
    kept = Path(target).with_suffix(".csv")
    everything = updated(read_scores(kept), [scores_of(Path(folder)) for folder in folders])
    ends = {end: part_of(everything, is_base=end == ENDS[0]) for end in ENDS}
    write_scores(kept, everything)
    for scores in ends.values():
        print(table(scores), "\n")
    print("| memory | cores | diagnostic tasks | robot tasks | rank correlation | p |")
    print("|---|--:|--:|--:|--:|--:|")
    figure, panels = plt.subplots(1, 4, figsize=(4 * SIZE_IN, SIZE_IN), layout="constrained", sharey=True)
    for axes, kind in zip(panels, ("all", *TYPES), strict=True):
        cores = list(ends["diagnostic"])
        for chosen in (cores, [core for core in cores if core != WITHOUT_MEMORY]):
            print(correlation_row(kind, ends, chosen))
        for number, core in enumerate(cores):
            place = tuple(mean_of(ends[end][core], kind) for end in ENDS)
            colour = plt.get_cmap("tab10")(number)
            axes.plot(*place, MARKERS[number], color=colour, alpha=0.8, label=core if kind == "all" else None)
        axes.axhline(0, color="0.8", zorder=0)
        axes.axvline(0, color="0.8", zorder=0)
        axes.set(title=kind, xlabel="score on diagnostic tasks", xlim=(-0.35, 1.2))
    panels[0].set(ylabel="score on robot tasks")
    figure.legend(loc="outside right center")
    figure.savefig(target, dpi=DPI)


def read_scores(kept: Path) -> Scores:
    """Return the scores of a CSV file; none without one."""
    scores: Scores = defaultdict(dict)
    if kept.exists():
        for row in csv.DictReader(kept.read_text().splitlines()):
            scores[row["core"]][row["task"]] = float(row["score"])
    return scores


def write_scores(kept: Path, scores: Scores) -> None:
    """Write them, sorted."""
    rows = sorted((task, core, score) for core, tasks in scores.items() for task, score in tasks.items())
    lines = ["core,task,score", *(f"{core},{task},{score:.3f}" for task, core, score in rows)]
    kept.write_text("\n".join(lines) + "\n")


def updated(kept: Scores, found: list[Scores]) -> Scores:
    """Return the kept scores, with what was found in the place of all that is kept of its tasks."""
    new = {task for scores in found for tasks in scores.values() for task in tasks}
    scores: Scores = defaultdict(dict)
    for core, tasks in kept.items():
        scores[core] = {task: score for task, score in tasks.items() if task not in new}
    for one in found:
        for core, tasks in one.items():
            scores[core] |= tasks
    return scores


def part_of(scores: Scores, *, is_base: bool) -> Scores:
    """Return the scores at one end. Every core needs one on every task, else there is no rank."""
    end = {
        core: {task: score for task, score in tasks.items() if task_spec(task).is_base == is_base}
        for core, tasks in scores.items()
    }
    all_tasks = {task for tasks in end.values() for task in tasks}
    for core, tasks in end.items():
        if missing := sorted(all_tasks - set(tasks)):
            raise SystemExit(f"{core} has no score on {', '.join(missing)}: train and evaluate it there.")
    return end


def scores_of(folder: Path) -> Scores:
    """Return the score of each core on each task, over all its run seeds."""
    found: dict[tuple[str, str], list[float]] = defaultdict(list)
    for record in read_run(folder).records:
        found[record.policy, record.task].append(counted(record))
    means = {key: float(np.mean(values)) for key, values in found.items()}
    scores: Scores = defaultdict(dict)
    for (policy, task), mean in means.items():
        if policy not in CONTROLS:
            low = next(means[control, task] for control in WITHOUT if (control, task) in means)
            scores[policy][task] = (mean - low) / (means[WITH, task] - low)
    return scores


def counted(record: EpisodeRecord) -> float:
    """Return the return of a diagnostic episode, or which part of a robot's choices was right."""
    if record.error is not None or record.episode_return is None:
        raise SystemExit(f"{record.policy} on {record.task}, seed {record.seed}: an error. Run it again.")
    return record.episode_return if task_spec(record.task).is_base else part_right(record)


def part_right(record: EpisodeRecord) -> float:
    """Return which part of the right candidates is among as many first touches; of a chain, at its place."""
    right, touched = record.right_candidates, record.touched_candidates
    if not right or touched is None:
        raise SystemExit(f"{record.task}, seed {record.seed}: its record does not say what was right.")
    if task_spec(record.task).memory == IN_ORDER:
        # Fewer may be touched than are right: what is missing at the end is not right.
        return sum(one == other for one, other in zip(right, touched, strict=False)) / len(right)
    return len(set(right) & set(touched[: len(right)])) / len(right)


def mean_of(scores: dict[str, float], kind: str) -> float:
    """Return the mean score over the tasks of a type of memory, or over all."""
    return float(np.mean([score for task, score in scores.items() if is_of(task, kind)]))


def is_of(task: str, kind: str) -> bool:
    """Whether a task is of a type; some are of several."""
    return kind in ("all", *task_spec(task).memory_types)


def correlation_row(kind: str, ends: dict[str, Scores], cores: list[str]) -> str:
    """Return Spearman's correlation, its 95 % interval (Bonett and Wright 2000), and a permutation test."""
    x, y = ([mean_of(ends[end][core], kind) for core in cores] for end in ENDS)
    counts = [str(sum(is_of(task, kind) for task in ends[end][cores[0]])) for end in ENDS]
    without = "" if WITHOUT_MEMORY in cores else f", without `{WITHOUT_MEMORY}`"
    row = [f"| {kind}", f"{len(cores)}{without}", *counts]
    if len(set(x)) == 1 or len(set(y)) == 1:
        return " | ".join([*row, "all alike at one end", " |"])
    found = permutation_test(
        (x,),
        lambda one: spearmanr(one, y).statistic,
        permutation_type="pairings",
        vectorized=False,
        rng=np.random.default_rng(0),
    )
    rho = float(found.statistic)
    error = norm.ppf(0.975) * np.sqrt((1 + rho**2 / 2) / (len(cores) - 3))
    low, high = np.tanh(np.arctanh(np.clip(rho, -0.9999, 0.9999)) + np.array([-error, error]))
    shown = f"{rho:.2f} [{low:.2f}, {high:.2f}]".replace("-", MINUS)
    return " | ".join([*row, shown, f"{found.pvalue:.3f} |"])


def table(scores: Scores) -> str:
    """Return the scores as a table, a row per core, the best first."""
    found = {task for row in scores.values() for task in row}
    tasks = sorted(found, key=lambda task: (TYPES.index(task_spec(task).memory), task))
    names = [task.removeprefix("mikasa_base/").removesuffix("-v0") for task in tasks]
    kinds = [f"*{', '.join(task_spec(task).memory_types)}*" for task in tasks]
    rows = [
        f"| core | {' | '.join(names)} | mean |",
        f"|---|{'--:|' * (len(tasks) + 1)}",
        f"| *memory* | {' | '.join(kinds)} | |",
    ]
    for core in sorted(scores, key=lambda core: -mean_of(scores[core], "all")):
        values = [*(scores[core][task] for task in tasks), mean_of(scores[core], "all")]
        shown = " | ".join(f"{value:.2f}" for value in values).replace("-", MINUS)
        rows.append(f"| `{core}` | {shown} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
