"""The results of the paper's table of VLA models, to be printed beside measured ones, never among them.

Source: "Memory, Benchmark & Robots" (ICLR 2026), appendix "VLA baselines", table "Performance of VLA
models on selected memory-intensive tasks from the MIKASA-Robo benchmark". Its caption: success rates
over 100 evaluation episodes, mean ± SEM. The appendix "Experiments Reproducing and Compute Resources":
three independent training runs of 100 episodes each, seeds 1 to 100, SEM over the three run means.
"""

from dataclasses import dataclass

SOURCE = "“Memory, Benchmark & Robots” (ICLR 2026), appendix “VLA baselines”, table of VLA models"
PROTOCOL = "mean ± SEM, 3 runs × 100 episodes"


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperFigure:
    """One cell of the paper's table."""

    task: str
    model: str
    n_action_steps: int
    success_once: float
    sem: float


_TASKS = (
    "ShellGameTouch-v0",
    "InterceptMedium-v0",
    "RememberColor3-v0",
    "RememberColor5-v0",
    "RememberColor9-v0",
)
# (model, K) -> mean and SEM per task, in the order of `_TASKS`. Octo's K is in the appendix's text.
_ROWS: dict[tuple[str, int], tuple[tuple[float, float], ...]] = {
    ("Octo-small", 4): ((0.46, 0.05), (0.39, 0.04), (0.45, 0.06), (0.17, 0.03), (0.11, 0.03)),
    ("OpenVLA", 4): ((0.12, 0.05), (0.06, 0.02), (0.21, 0.00), (0.09, 0.02), (0.08, 0.02)),
    ("OpenVLA", 8): ((0.47, 0.05), (0.14, 0.03), (0.59, 0.04), (0.16, 0.03), (0.06, 0.02)),
    ("SpatialVLA", 4): ((0.23, 0.04), (0.27, 0.04), (0.27, 0.05), (0.17, 0.03), (0.11, 0.03)),
    ("π0", 4): ((0.33, 0.05), (0.42, 0.03), (0.35, 0.04), (0.22, 0.04), (0.15, 0.02)),
}

PAPER_TABLE: tuple[PaperFigure, ...] = tuple(
    PaperFigure(task=task, model=model, n_action_steps=n_action_steps, success_once=mean, sem=sem)
    for (model, n_action_steps), cells in _ROWS.items()
    for task, (mean, sem) in zip(_TASKS, cells, strict=True)
)
