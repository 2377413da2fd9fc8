"""Find the rerun files of a run for the viewer, or explain why there are none."""

from collections.abc import Sequence
from pathlib import Path

from vla_eval.errors import ViewingError, unknown_name
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import rrd_file
from vla_eval.storage.run_folder import StoredRun

MOST_OPENED = 5  # files that the viewer gets at once, unless the user chooses


def pick(
    run: StoredRun, *, task: str | None, policy: str | None, n_action_steps: int | None, seed: int | None
) -> list[Path]:
    """Return the rerun files of the requested episodes (None: of any), in the order of the records."""
    names = {"task": task, "policy": policy, "n_action_steps": n_action_steps}
    for name, wanted in names.items():
        known = {str(getattr(record, name)) for record in run.records}
        if wanted is not None and str(wanted) not in known:
            raise unknown_name(name, str(wanted), known, where=str(run.path))
    wished = [
        record
        for record in run.records
        if all(wanted in (None, getattr(record, name)) for name, wanted in {**names, "seed": seed}.items())
    ]
    found = [rrd_file(run.path, record) for record in wished if rrd_file(run.path, record).is_file()]
    if not found:
        raise ViewingError(_why_none(run, wished))
    return found


def _why_none(run: StoredRun, wished: Sequence[EpisodeRecord]) -> str:
    captured = sorted({record.seed for record in run.records if rrd_file(run.path, record).is_file()})
    if captured:
        shown = ", ".join(map(str, captured[:10])) + (", …" if len(captured) > 10 else "")
        what = "no such episode" if not wished else "of the episodes asked for none was captured"
        return f"{run.path}: {what}. Seeds with a rerun file: {shown}."
    return (
        f"{run.path}: holds no rerun files. What has a result is not run again: evaluate into another "
        f"folder, with --capture-rrd all|failures|successes|N --out DIR."
    )
