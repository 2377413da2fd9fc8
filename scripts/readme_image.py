"""Draw the image at the top of the README: a cue, a delay, a choice; and memory against no memory.

The frames are from `docs/images/RememberColor3-v0.png` (`scripts/task_images.py`), the rates from a run of
`configs/demo_memory.yaml`.

Usage: .venv/bin/python scripts/readme_image.py RUN_FOLDER [PNG]
"""

import sys
from pathlib import Path

import matplotlib.image
from matplotlib.figure import Figure

from vla_eval.results.own_statistics import EPISODES, SUCCESS
from vla_eval.results.report import build_table
from vla_eval.results.success_table import Row
from vla_eval.storage.run_folder import read_run

SHEET = Path("docs/images/RememberColor3-v0.png")
FRAME_PX, PITCH_PX = 128, 130  # of the sheet: the size of an image, and the distance of two
FRAMES = (
    (0, "cue: a green cube, 5 steps"),
    (1, "delay: an empty table, 5 steps"),
    (4, "choice: which one was it?"),
)
POLICIES = {  # from the top: the policy, and its words
    "memory_color3": ("a policy with memory", "#0072b2"),
    "memoryless_color3": ("its twin without memory", "#d55e00"),
    "cue_blind": ("chance: an arm without the cue", "#5a606b"),
}
INK = "#1b1d21"


def draw(run: Path) -> Figure:
    """Return the figure, 880 px wide."""
    table = build_table([read_run(run)])
    rows = {row.policy: row for row in table.rows}
    figure = Figure(figsize=(8.8, 3.9), dpi=100, facecolor="white")
    sheet = matplotlib.image.imread(SHEET)
    for place, (column, title) in enumerate(FRAMES):
        axes = figure.add_axes((0.01 + place * 0.333, 0.46, 0.315, 0.46))
        # The lower part of the base camera's image: the table, and the hand at the choice.
        axes.imshow(sheet[30:106, column * PITCH_PX : column * PITCH_PX + FRAME_PX], interpolation="nearest")
        axes.set_title(title, fontsize=11, color=INK)
        axes.axis("off")
    axes = figure.add_axes((0.36, 0.14, 0.53, 0.29))
    for y, (policy, (words, color)) in enumerate(POLICIES.items()):
        _bar(axes, y, rows[policy], color)
        axes.text(-0.02, y, words, ha="right", va="center", fontsize=11, color=INK)
    axes.set(xlim=(0, 1), ylim=(2.6, -0.6), yticks=[], xticks=[0, 0.25, 0.5, 0.75, 1])
    n_episodes = rows["cue_blind"][EPISODES].n_episodes
    axes.set_xlabel(f"success with its 95 % interval, {n_episodes} episodes", fontsize=10)
    axes.spines[["top", "right", "left"]].set_visible(False)
    return figure


def _bar(axes, y: int, row: Row, color: str) -> None:  # type: ignore[no-untyped-def]  # matplotlib's axes
    success = row[SUCCESS]
    axes.barh(y, success.success_once, height=0.62, color=color, alpha=0.85)
    axes.plot([success.ci_low, success.ci_high], [y, y], color=INK, linewidth=1.6)
    axes.text(1.03, y, f"{success.success_once:.2f}", va="center", fontsize=12, color=INK)


def main() -> None:
    """Write the image."""
    target = Path(sys.argv[2] if len(sys.argv) > 2 else "docs/images/memory.png")
    draw(Path(sys.argv[1])).savefig(target)


if __name__ == "__main__":
    main()
