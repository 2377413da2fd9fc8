"""How much has to be stored: is one frame enough, or does it take several?

The `oracle` runs each task with arm and gripper held until the response; small frames of each control step
are kept, and which cues are in view. The fewest frames that show the answer are counted, and linear probes
say whether it can be read from the newest frame and a stored one, or from all. `docs/audit.md` has the
verdicts.
"""

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vla_eval.audit.evaluations import OFFICIAL_FIELDS
from vla_eval.audit.frame_probes import FrameProbes, Right
from vla_eval.config.evaluation import CaptureConfig, EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import PairCounts, Share, mcnemar_exact, p_above
from vla_eval.results.printed_table import Column, PrintedTable, cells_of, write_tables
from vla_eval.results.shipped_audit import INTEGRATED, NEWEST, ONE, SEVERAL, UNREAD, Asked, StoredFrames
from vla_eval.storage.capture_files import frames_file
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.spec import TaskSpec

NAME = "audit_stored_frames"
CONTROL = "oracle"
MOST_FRAMES = 24  # evenly spread, among which the best is looked for, and in the probe that gets all
ALPHA = 0.01  # of each test
READ = 0.9  # share of episodes; with less, a verdict would be about the probe
LEAST_EPISODES = 20


def stored_frames_config(
    tasks: Sequence[str],
    *,
    episodes: int,
    workers: int | Literal["auto"],
    settings: Mapping[str, Any],  # Any: other fields of `EvalConfig`
) -> EvalConfig:
    """Return the evaluation whose frames are read; a `RecipeError` without a task that shows something."""
    shown = tuple(task for task in tasks if task_spec(task).has_candidates)
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
        rows += [_row(task, one, episodes) for one in _asked(task_spec(task))]
    return rows


def _asked(task: TaskSpec) -> tuple[Asked, ...]:
    if task.several_right:
        return ("set", "order") if task.shows_one_by_one else ("set",)
    return ("place",) if task.has_alike_candidates else ("item",)


def _row(task: str, asked: Asked, episodes: Sequence[tuple[EpisodeRecord, EpisodeMemory]]) -> StoredFrames:
    spec = task_spec(task)
    labels = [_answers(record, asked) for record, _ in episodes]
    probes = FrameProbes.of(
        [memory for _, memory in episodes], labels, [record.seed for record, _ in episodes]
    )
    newest, earlier = probes.newest, range(probes.newest)
    cue = probes.cue or tuple(earlier)
    best, best_step = probes.best_of([(newest, step) for step in (*_spread(earlier), *probes.own)])
    everything = probes.everything([*_spread(cue), *probes.own, newest])
    chance = max(labels.count(one) for one in set(labels)) / len(labels)
    alone = probes.best_of([(newest,)])[0]
    found = NEWEST if _is_read(alone, chance) else verdict(best, everything, chance)
    frames = [fewest_frames(one.shown, record, left_out=spec.cue_leaves_out) for record, one in episodes]
    n_frames = None if spec.is_tracked else _most(frames)
    return StoredFrames(
        task=task,
        version=spec.version,
        asked=asked,
        n_episodes=len(episodes),
        chance=chance,
        newest=_n(alone),
        first=_n(probes.best_of([(newest, probes.first)])[0]),
        cue_end=_n(probes.best_of([(newest, probes.cue_end)])[0]),
        best=_n(best),
        best_step=best_step if best_step < newest else None,
        all=_n(everything),
        n_frames=n_frames,
        probes=found,
        verdict=INTEGRATED if spec.is_tracked else _of_both(found, n_frames),
    )


def _of_both(probes: str, n_frames: int | None) -> str:
    if n_frames is None or probes in (SEVERAL, NEWEST):
        return probes
    return ONE if n_frames == 1 else SEVERAL


def fewest_frames(
    shown: NDArray[np.bool_] | None, record: EpisodeRecord, *, left_out: bool = False
) -> int | None:
    """Return how many frames it takes to see all that is right; None if that is not known, or never shown.

    Args:
        shown: (T, N) which candidates' cues are in view at each step.
        record: the episode, whose right candidates are asked for.
        left_out: the cue shows all but the right ones.
    """
    right = frozenset(record.right_candidates or ())
    if shown is None or not right:
        return None
    if left_out:
        right = frozenset(range(shown.shape[1])) - right
    sets = {frozenset(np.flatnonzero(row).tolist()) for row in shown}
    for n in range(1, len(sets) + 1):
        if any(right <= frozenset().union(*some) for some in itertools.combinations(sets, n)):
            return n
    return None


def _most(numbers: Sequence[int | None]) -> int | None:
    known = [number for number in numbers if number is not None]
    return max(known) if known and len(known) == len(numbers) else None


def verdict(best: Right, everything: Right, chance: float) -> str:
    """Return what the two probes say: from the newest and the best stored frame, and from all frames."""
    if not _is_read(max(best, everything, key=_n), chance):
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


def _is_read(right: Right, chance: float) -> bool:
    """Whether a probe is right so often that what it gets tells the answer."""
    return _n(right) >= READ * len(right) and p_above(_n(right), len(right), chance) < ALPHA


def render_stored_frames(rows: Sequence[StoredFrames], style: Literal["markdown", "json"]) -> str:
    """Return the table."""
    if style == "json":
        return json.dumps([asdict(row) for row in rows], indent=2)
    notes = [
        "Share of episodes in which linear probes are right in all that is asked; each episode is predicted "
        "by probes of other seeds. set: which items; order: in the order shown.",
        f"Probes: {NEWEST}: it alone is right in {READ:.0%} of the episodes, and above chance; {ONE}: all "
        f"frames together are not better than the newest and one other (exact McNemar "
        f"test, {ALPHA}); {UNREAD}: neither is right so often.",
        "Frames that show it: the fewest that have all that is right in view, by the simulator. The verdict "
        "is about them; where the probes find that one is not enough, or none is needed, theirs holds.",
    ]
    return write_tables([PrintedTable(columns=_COLUMNS, rows=cells_of(_COLUMNS, rows), notes=notes)], style)


def _answers(record: EpisodeRecord, asked: Asked) -> tuple[int, ...]:
    """Return what the probes have to tell, a number each."""
    if asked == "place":
        return (-1 if record.target_place is None else record.target_place,)
    if asked == "item":
        return (-1 if record.target is None else record.target,)
    right = record.right_candidates or ()
    if asked == "order":
        return tuple(right)
    return tuple(int(item in right) for item in range(record.n_candidates or 0))


def _spread(steps: Sequence[int]) -> list[int]:
    """Return at most `MOST_FRAMES` of them, evenly spread."""
    chosen = np.linspace(0, len(steps) - 1, min(MOST_FRAMES, len(steps))).round().astype(int)
    return [steps[index] for index in chosen]


def _n(right: Right) -> int:
    return int(right.sum())


def _share(n: int, row: StoredFrames) -> str:
    return str(Share(n, row.n_episodes))


_COLUMNS: tuple[Column[StoredFrames], ...] = (
    Column("task", lambda row: row.task, is_number=False),
    Column("asked", lambda row: row.asked, is_number=False),
    Column("chance", lambda row: f"{row.chance:.2f}"),
    Column("newest", lambda row: _share(row.newest, row)),
    Column("first + newest", lambda row: _share(row.first, row)),
    Column("cue's last + newest", lambda row: _share(row.cue_end, row)),
    Column("best + newest", lambda row: _share(row.best, row)),
    Column("step", lambda row: "—" if row.best_step is None else str(row.best_step)),
    Column("all", lambda row: _share(row.all, row)),
    Column("frames that show it", lambda row: "—" if row.n_frames is None else str(row.n_frames)),
    Column("probes", lambda row: row.probes, is_number=False),
    Column("verdict", lambda row: row.verdict, is_number=False),
)
