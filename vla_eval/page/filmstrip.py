"""A contact sheet per row of the table: ten seeds, cue | reveal | touch, an edge coloured by the outcome."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.errors import ViewingError, some_of
from vla_eval.records import EpisodeRecord
from vla_eval.results.grouping import RowEpisodes, RowKey, group_runs
from vla_eval.storage.capture_files import stills_file
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.objects.item_names import item_names
from vla_eval.viz.contact_sheet import SheetRow, contact_sheet
from vla_eval.viz.frames import FAILURE_COLOR, SUCCESS_COLOR
from vla_eval.viz.moments import read_stills

N_EPISODES = 10
LEGEND = "viewer camera, not seen by the policy; green edge: success, orange: failure"


@dataclass(frozen=True, slots=True, kw_only=True)
class Filmstrips:
    """The sheets that were written, and the rows without a captured episode."""

    files: tuple[Path, ...]
    not_captured: tuple[str, ...]


def write_filmstrips(runs: Sequence[StoredRun], folder: Path) -> Filmstrips:
    """Write `TASK_POLICY_Kn.png` into a folder for each row of the table that has captured episodes."""
    where = {id(record): run.path for run in runs for record in run.records}
    files, missing = [], []
    for key, group in group_runs(runs).groups.items():
        rows = _rows(group, where)
        if not rows:
            missing.append(_name(key))
            continue
        columns = _columns(group.results)
        files.append(folder / f"{re.sub(r'[^A-Za-z0-9._=-]+', '_', _name(key))}.png")
        sheet = contact_sheet(columns, rows, title=(_name(key), LEGEND))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            files[-1].write_bytes(sheet)
        except OSError as exc:
            raise ViewingError(f"{files[-1]}: cannot be written ({exc}). Name another --filmstrip.") from exc
    if not files:
        shown = some_of(str(run.path) for run in runs)
        raise ViewingError(
            f"--filmstrip: {shown}: holds no stills of episodes. They are made with videos, and what has a "
            f"result is not run again: evaluate into another folder, with --capture-video {N_EPISODES} "
            "--out DIR."
        )
    return Filmstrips(files=tuple(files), not_captured=tuple(missing))


def _columns(records: Sequence[EpisodeRecord]) -> tuple[str, str, str]:
    """Return the titles above the moments of a row's episodes, see `viz.moments.Moments`."""
    choosing = [record for record in records if record.n_candidates]
    if not choosing:
        return "start", "middle", "end"
    ended = any(record.first_choice is None for record in choosing)
    return "cue", "reveal", "touch, or end without one" if ended else "touch"


def _rows(group: RowEpisodes, where: dict[int, Path]) -> list[SheetRow]:
    """Return the first captured episodes of a row, by run and seed."""
    rows: list[SheetRow] = []
    for run in group.runs:
        for _, record in sorted(run.results.items()):
            path = stills_file(where[id(record)], record)
            if len(rows) < N_EPISODES and path.is_file():
                rows.append(_row(record, path))
    return rows


def _row(record: EpisodeRecord, path: Path) -> SheetRow:
    try:
        frames = read_stills(path)
    except OSError as exc:
        problem = f"cannot be read as stills of an episode ({exc}). Remove the file."
        raise ViewingError(f"{path}: {problem}") from exc
    lines = [f"seed {record.seed}"] + ([f"run {record.run}"] if record.run else [])
    if record.n_candidates and record.target is not None:
        names = item_names(record.task, record.n_candidates, given=record.candidate_names)
        chosen = "none" if record.first_choice is None else names[record.first_choice]
        lines += [f"cue {names[record.target]}", f"chose {chosen}"]
    edge = SUCCESS_COLOR if record.outcome == "success" else FAILURE_COLOR
    return SheetRow(name="\n".join([*lines, record.outcome]), frames=frames, edge=edge)


def _name(key: RowKey) -> str:
    variant = f" {key.variant}" if key.variant else ""
    return f"{key.task} {key.policy} K{key.n_action_steps}{variant}"
