"""The data of the page's list of episodes, as numbers; the browser draws the rows that are shown."""

import json
import os
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from markupsafe import Markup

from vla_eval.page.material import Material
from vla_eval.storage.capture_files import rrd_file, strip_file, video_file
from vla_eval.tasks.objects.item_names import item_names

OUTCOMES = ("success", "failure", "error")
FIELDS = ("row", "run", "seed", "outcome", "step", "target", "chosen", "error", "video", "rrd", "strip")


class EpisodeList(NamedTuple):
    """The number of episodes, and their data as JSON for a `script` element."""

    n_episodes: int
    data: Markup


def episode_list(material: Material, folder: Path | None) -> EpisodeList:
    """Return all episodes of the table's rows, in the order of `FIELDS`; what is undefined is null."""
    files = _files(material, folder or Path())
    errors: dict[str, int] = {}
    episodes: list[list[object]] = []
    rows = []
    for number, row in enumerate(material.table.rows):
        group = row.episodes
        n_candidates = max((record.n_candidates or 0 for record in group.results), default=0)
        given = next((record.candidate_names for record in group.results if record.candidate_names), None)
        rows.append(
            {
                "task": row.task,
                "policy": row.policy,
                "k": row.n_action_steps,
                "setting": material.table.variants[row.variant] if row.variant else None,
                "items": item_names(row.task, n_candidates, given=given) if n_candidates else [],
            }
        )
        for run in group.runs:
            for record in run.records.values():
                error = None
                if record.error is not None:
                    error = errors.setdefault(
                        f"{record.error.kind}: {record.error.message[:200]}", len(errors)
                    )
                episodes.append(
                    [
                        *(number, record.run, record.seed, OUTCOMES.index(record.outcome)),
                        *(record.success_step, record.target, record.first_choice, error),
                        *files.get(id(record), (None, None, None)),
                    ]
                )
    names = {"fields": FIELDS, "outcomes": OUTCOMES}
    data = {**names, "rows": rows, "errors": list(errors), "episodes": episodes}
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    # `<` is escaped as JSON does it, so that no text in it can end the element.
    return EpisodeList(len(episodes), Markup(text.replace("<", "\\u003c")))


def _files(material: Material, folder: Path) -> dict[int, tuple[str | None, ...]]:
    """Return the addresses, relative to the page, of video, rerun file and strip of each record."""
    found = {}
    for run in material.runs:
        for record in run.records:
            places = (
                video_file(run.path, record),
                rrd_file(run.path, record),
                strip_file(run.path, record),
            )
            if any(place.is_file() for place in places):
                found[id(record)] = tuple(
                    quote(os.path.relpath(one, folder)) if one.is_file() else None for one in places
                )
    return found
