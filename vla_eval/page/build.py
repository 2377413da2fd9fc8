"""Build the report page: one HTML file. It computes no number, and escapes what is not `Markup`."""

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict, Unpack

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vla_eval import __version__
from vla_eval.errors import ReportError
from vla_eval.page import choice_sections, machine_sections, rates
from vla_eval.page.episode_list import episode_list
from vla_eval.page.material import Material, gather
from vla_eval.page.probe_section import ProbeSection
from vla_eval.results.own_statistics import EPISODES
from vla_eval.results.table_formats import render, side_tables
from vla_eval.results.verdict import verdicts
from vla_eval.storage.run_folder import StoredRun

PAGE_FILE = "index.html"
TEMPLATE = "page.html.j2"
SCRIPT = "episodes.js"
N_OPEN_MATRICES = 12  # rows of the table; those of more are folded


class PageOptions(TypedDict, total=False):
    """What a page is made with: as for `build_table` and `render`, and the probes among the run folders."""

    baseline: str | None
    probes: Sequence[ProbeSection]
    protocols: Sequence[str]
    published: str | None


def build_page(
    runs: Sequence[StoredRun], *, folder: Path | None = None, **options: Unpack[PageOptions]
) -> str:
    """Return the page of runs, the same bytes for the same runs; its links begin at `folder`."""
    published = options.get("published")
    material = gather(runs, baseline=options.get("baseline"), protocols=options.get("protocols", ()))
    chunks = rates.chunk_plots(material)
    templates = _templates()
    script = templates.get_template(SCRIPT).render()
    return templates.get_template(TEMPLATE).render(
        title="Evaluation: " + ", ".join(dict.fromkeys(run.description.name for run in material.runs)),
        summary=_summary(material),
        version=__version__,
        material=material,
        probes=options.get("probes", ()),
        verdicts=verdicts(material.table),
        episodes=episode_list(material, folder),
        script=Markup(script),
        # What the page's policy allows to run: this script and no other.
        script_hash=f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}",
        n_open_matrices=N_OPEN_MATRICES,
        results=rates.results(material),
        sides=side_tables(material.table, published=published),
        success=rates.success_plots(material),
        chunks=chunks,
        sweep=rates.chunk_sweep(material) if chunks.charts else None,
        paired=rates.paired_table(material),
        steps=rates.steps_plots(material),
        choices=choice_sections.choices(material),
        latency=machine_sections.latency(material),
        errors=machine_sections.errors_table(material),
        videos=machine_sections.videos(material),
        passport=machine_sections.passport(material),
        reproductions=[machine_sections.reproduction(run) for run in material.runs],
        # `<` is escaped as JSON does it, so that no text in it can end the element.
        report=Markup(render(material.table, "json", published=published).replace("<", "\\u003c")),
    )


def write_page(runs: Sequence[StoredRun], folder: Path, **options: Unpack[PageOptions]) -> Path:
    """Write the page into a folder, which is made if it is not there, and return its path."""
    page = build_page(runs, folder=folder, **options)
    path = folder / PAGE_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8", errors="backslashreplace")  # as on standard output
    except OSError as exc:
        raise ReportError(f"{path}: cannot be written ({exc.strerror or exc}). Name another --html.") from exc
    return path


def _templates() -> Environment:
    environment = Environment(
        loader=PackageLoader("vla_eval.page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["with_code"] = with_code
    return environment


def with_code(text: str) -> Markup:
    """Return text with the names in backticks, as in Markdown, set as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # an unpaired backtick is not markup
        return Markup.escape(text)
    code = Markup("<code>{}</code>")
    return Markup().join(code.format(part) if i % 2 else part for i, part in enumerate(parts))


def _summary(material: Material) -> str:
    rows = material.table.rows
    counts = (
        (sum(row[EPISODES].n_episodes for row in rows), "episode with a result", "episodes with a result"),
        (sum(row[EPISODES].n_errors for row in rows), "error", "errors"),
        (len(material.tasks), "task", "tasks"),
        (len(material.colors), "policy", "policies"),
        (len(material.runs), "run folder", "run folders"),
    )
    return ", ".join(f"{n} {one if n == 1 else several}" for n, one, several in counts)
