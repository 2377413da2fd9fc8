"""How much has to be stored: is one frame enough, or does it take several?

The `oracle` runs each task with arm and gripper held until the response, and small frames
of each control step are kept. Linear probes say what was shown: from the newest frame and one stored frame,
or from all frames. `docs/audit.md` defines the verdicts.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.audit.evaluations import OFFICIAL_FIELDS
from vla_eval.config.evaluation import CaptureConfig, EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import PairCounts, mcnemar_exact, p_above, wilson_interval
from vla_eval.results.linear_probe import Vectors, folds_of, predicted
from vla_eval.results.printed_table import Column, PrintedTable, cells_of, write_tables
from vla_eval.storage.capture_files import frames_file
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec

NAME = "audit_stored_frames"
CONTROL = "oracle"
MOST_FRAMES = 24  # of all frames, evenly spread, in the probe that gets them all
ALPHA = 0.01  # of each test
READ = 0.9  # share of episodes; with less, a verdict would be about the probe
LEAST_EPISODES = 20

ONE, SEVERAL, UNREAD = "one stored frame is enough", "several frames", "not read by linear probes"
Asked = Literal["item", "set", "order"]
Right = NDArray[np.bool_]


class Answer(NamedTuple):
    """In how many episodes a probe is right in all that it is asked for."""

    n: int
    of: int

    def __str__(self) -> str:
        """Return `0.93 [0.84, 0.97]`."""
        low, high = wilson_interval(self.n, self.of) or (0.0, 1.0)
        return f"{self.n / self.of:.2f} [{low:.2f}, {high:.2f}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFrames:
    """One task, and one thing that is asked of it."""

    task: str
    asked: Asked  # the item; the set of items; the items in the order shown
    chance: float  # of the most frequent answer
    newest: Answer  # from the newest frame alone, the first of the response
    first: Answer  # from the first frame and the newest
    cue_end: Answer  # from the last frame of the cue and the newest
    best: Answer  # from the newest and the best other one, which the other folds choose
    best_step: int  # the one that most folds choose
    all: Answer  # from all frames
    verdict: str


def stored_frames_config(
    tasks: Sequence[str],
    *,
    episodes: int,
    workers: int | Literal["auto"],
    settings: Mapping[str, Any],  # Any: other fields of `EvalConfig`
) -> EvalConfig:
    """Return the evaluation whose frames are read; a `RecipeError` without a task that shows something."""
    shown = tuple(task for task in tasks if task_spec(task).candidates is not None)
    if not shown:
        raise RecipeError(
            "--stored-frames: expected a task that shows candidates to be remembered, found "
            f"{', '.join(tasks)}."
        )
    is_official = all(task_spec(task).is_official for task in shown)
    own = {**(OFFICIAL_FIELDS if is_official else {}), **settings}
    rule = {} if is_official else {"freeze_until_choice": True}
    env = own.pop("env", {})
    return EvalConfig(
        name=NAME,
        tasks=shown,
        policies=(CONTROL,),
        n_action_steps=(1,),
        episodes=episodes,
        workers=workers,
        env={**rule, **env},
        capture=CaptureConfig(frames=True),
        **{"stop_at_success": True, **own},
    )


def read_stored_frames(config: EvalConfig, out: Path) -> list[StoredFrames]:
    """Read the run and return a row for each task and what is asked of it."""
    run = read_run(out / config.name)
    rows = []
    for task in config.tasks:
        records = [record for record in run.records if record.task == task and record.outcome != "error"]
        files = [(record, frames_file(run.path, record)) for record in records]
        episodes = [(record, EpisodeMemory.read(path)) for record, path in files if path.is_file()]
        if len(episodes) < LEAST_EPISODES:
            raise RecipeError(
                f"{run.path}: {task}: expected frames of at least {LEAST_EPISODES} episodes, found "
                f"{len(episodes)} of {len(records)}. Ask for more with --episodes."
            )
        several = task_spec(task).several_right
        asked: tuple[Asked, ...] = ("item",)
        if several:
            asked = ("set", "order") if task_spec(task).shows_one_by_one else ("set",)
        rows += [_row(task, one, episodes) for one in asked]
    return rows


def _row(task: str, asked: Asked, episodes: Sequence[tuple[EpisodeRecord, EpisodeMemory]]) -> StoredFrames:
    n_steps = min(len(memory.steps) for _, memory in episodes)
    # (N, T, D), aligned at the first frame of the response: the newest is the last.
    frames = np.array([_flat(memory)[-n_steps:] for _, memory in episodes])
    labels = [_answers(record, asked) for record, _ in episodes]
    answers, folds = np.array(labels), folds_of([record.seed for record, _ in episodes])
    newest = frames[:, -1]
    by_step = np.array([_right([frames[:, t], newest], answers, folds) for t in range(n_steps - 1)])
    spread = np.unique(np.linspace(0, n_steps - 1, MOST_FRAMES).round().astype(int))
    everything = _right([frames[:, t] for t in spread], answers, folds)
    best, best_step = _best(by_step, folds)
    shown = [t for t in range(n_steps - 1) if all(_in_cue(memory)[-n_steps:][t] for _, memory in episodes)]
    counts = [labels.count(one) for one in set(labels)]
    chance = max(counts) / len(labels)
    return StoredFrames(
        task=task,
        asked=asked,
        chance=chance,
        newest=_answer(_right([newest], answers, folds)),
        first=_answer(by_step[0]),
        cue_end=_answer(by_step[shown[-1] if shown else 0]),
        best=_answer(best),
        best_step=best_step,
        all=_answer(everything),
        verdict=verdict(best, everything, chance),
    )


def verdict(best: Right, everything: Right, chance: float) -> str:
    """Return what the two probes say: from the newest and the best stored frame, and from all frames."""
    most = max(int(best.sum()), int(everything.sum()))
    if most < READ * len(best) or p_above(most, len(best), chance) >= ALPHA:
        return UNREAD
    pairs = PairCounts(
        both=int((best & everything).sum()),
        only_first=int((~best & everything).sum()),
        only_second=int((best & ~everything).sum()),
        neither=int((~best & ~everything).sum()),
    )
    test = mcnemar_exact(pairs)
    more = pairs.only_first > pairs.only_second and test is not None and test.p_value < ALPHA
    return SEVERAL if more else ONE


def render_stored_frames(rows: Sequence[StoredFrames], style: Literal["markdown", "json"]) -> str:
    """Return the table."""
    if style == "json":
        return json.dumps([_json(row) for row in rows], indent=2)
    notes = [
        "Share of episodes in which linear probes are right in all that is asked; each episode is predicted "
        "by probes of other seeds. set: which items; order: in the order shown.",
        f"{ONE}: all frames together are not better than the newest and one other (exact McNemar test, "
        f"{ALPHA}); {UNREAD}: neither is right in {READ:.0%} of the episodes, and above chance.",
    ]
    return write_tables([PrintedTable(columns=_COLUMNS, rows=cells_of(_COLUMNS, rows), notes=notes)], style)


def _json(row: StoredFrames) -> dict[str, Any]:
    values = {one.name: getattr(row, one.name) for one in fields(row)}
    return {name: v._asdict() if isinstance(v, Answer) else v for name, v in values.items()}


def _answers(record: EpisodeRecord, asked: Asked) -> tuple[int, ...]:
    """Return what the probes have to tell, a number each."""
    if asked == "item":
        return (-1 if record.target is None else record.target,)
    right = record.right_candidates or ()
    if asked == "order":
        return tuple(right)
    return tuple(int(item in right) for item in range(record.n_candidates or 0))


def _flat(memory: EpisodeMemory) -> NDArray[np.float32]:
    """Return the frames of all cameras, (T, D)."""
    rows = [memory.frames[name].reshape(len(memory.steps), -1) for name in sorted(memory.frames)]
    return np.concatenate(rows, axis=1).astype(np.float32)


def _in_cue(memory: EpisodeMemory) -> NDArray[np.bool_]:
    return np.zeros(len(memory.steps), dtype=bool) if memory.in_cue is None else memory.in_cue


def _right(
    parts: Sequence[NDArray[np.float32]], answers: NDArray[np.int64], folds: NDArray[np.int64]
) -> Right:
    """Return in which episodes the probes are right in everything that is asked."""
    numbers: list[Vectors] = [part.astype(np.float64) for part in parts]
    told = [predicted(numbers, column, folds) == column for column in answers.T]
    right: Right = np.all(told, axis=0)
    return right


def _best(by_step: NDArray[np.bool_], folds: NDArray[np.int64]) -> tuple[Right, int]:
    """Return what the best step tells of each episode, by the step that is best in the other folds."""
    found = np.zeros(by_step.shape[1], dtype=bool)
    chosen = []
    for fold in np.unique(folds):
        step = int(by_step[:, folds != fold].sum(axis=1).argmax())
        found[folds == fold] = by_step[step, folds == fold]
        chosen.append(step)
    return found, max(set(chosen), key=chosen.count)


def _answer(right: Right) -> Answer:
    return Answer(int(right.sum()), len(right))


_COLUMNS: tuple[Column[StoredFrames], ...] = (
    Column("task", lambda row: row.task, is_number=False),
    Column("asked", lambda row: row.asked, is_number=False),
    Column("chance", lambda row: f"{row.chance:.2f}"),
    Column("newest", lambda row: str(row.newest)),
    Column("first + newest", lambda row: str(row.first)),
    Column("cue's last + newest", lambda row: str(row.cue_end)),
    Column("best + newest", lambda row: str(row.best)),
    Column("step", lambda row: str(row.best_step)),
    Column("all", lambda row: str(row.all)),
    Column("verdict", lambda row: row.verdict, is_number=False),
)
