"""Find the rerun files of a run for the viewer, or explain why there are none."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from vla_eval.errors import ViewingError, unknown_name
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import rrd_file
from vla_eval.storage.run_folder import StoredRun

MOST_OPENED = 5  # files that the viewer gets at once, unless the user chooses


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """Which episodes; None is any."""

    task: str | None = None
    policy: str | None = None
    n_action_steps: int | None = None
    seed: int | None = None


def pick(run: StoredRun, wish: Wish) -> list[Path]:
    """Return the rerun files of the requested episodes, in the order of the records."""
    for name in ("task", "policy", "n_action_steps"):
        wanted = getattr(wish, name)
        known = {str(getattr(record, name)) for record in run.records}
        if wanted is not None and str(wanted) not in known:
            raise unknown_name(name, str(wanted), known, where=str(run.path))
    wished = [
        record
        for record in run.records
        if all(wanted in (None, getattr(record, name)) for name, wanted in asdict(wish).items())
    ]
    found = [rrd_file(run.path, record) for record in wished if rrd_file(run.path, record).is_file()]
    if not found:
        raise ViewingError(_why_none(run, wished, wish))
    return found


def _why_none(run: StoredRun, wished: Sequence[EpisodeRecord], wish: Wish) -> str:
    captured = sorted({record.seed for record in run.records if rrd_file(run.path, record).is_file()})
    if captured:
        shown = ", ".join(map(str, captured[:10])) + (", …" if len(captured) > 10 else "")
        what = "no such episode" if not wished else "of the episodes asked for none was captured"
        return f"{run.path}: {what}. Seeds with a rerun file: {shown}."
    return (
        f"{run.path}: holds no rerun files. What has a result is not run again: evaluate into another "
        f"folder, with --capture-rrd all|failures|successes|N --out DIR."
    )
