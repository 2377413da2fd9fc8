"""Build the report page: one self-contained HTML file. It computes no number.

The markup is in `templates/`. Whatever a template is given is escaped, unless it is `Markup`: the drawings of
`svg.py` and the JSON report.
"""

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vla_eval import __version__
from vla_eval.errors import ReportError
from vla_eval.page import choice_sections, machine_sections, rates
from vla_eval.page.episode_list import episode_list
from vla_eval.page.material import Material, gather
from vla_eval.page.probe_section import ProbeSection
from vla_eval.results.own_statistics import EPISODES
from vla_eval.results.table_formats import render
from vla_eval.results.verdict import verdicts
from vla_eval.storage.run_folder import StoredRun

PAGE_FILE = "index.html"
TEMPLATE = "page.html.j2"
SCRIPT = "episodes.js"
N_OPEN_MATRICES = 12  # rows of the table; those of more are folded


def build_page(
    runs: Sequence[StoredRun],
    *,
    baseline: str | None = None,
    probes: Sequence[ProbeSection] = (),
    protocols: Sequence[str] = (),
    published: str | None = None,
    folder: Path | None = None,
) -> str:
    """Return the page of one or more runs; the same runs give the same bytes.

    Args:
        runs: what the run folders hold. Timings and videos are read from the folders themselves.
        baseline: as for `build_table`.
        probes: those that the run folders are of.
        protocols: as for `build_table`.
        published: as for `render`.
        folder: where the page will be, for links to captures; None: the current folder.

    Raises:
        ReportError: there is no episode yet.
        UnknownNameError: there is no such baseline or protocol.
    """
    material = gather(runs, baseline=baseline, protocols=protocols)
    chunks = rates.chunk_plots(material)
    templates = _templates()
    script = templates.get_template(SCRIPT).render()
    return templates.get_template(TEMPLATE).render(
        title="Evaluation: " + ", ".join(dict.fromkeys(run.description.name for run in material.runs)),
        summary=_summary(material),
        version=__version__,
        material=material,
        probes=probes,
        verdicts=verdicts(material.table),
        episodes=episode_list(material, folder),
        script=Markup(script),
        script_hash=_script_hash(script),
        n_open_matrices=N_OPEN_MATRICES,
        results=rates.results(material),
        sides=rates.side_sections(material.table, published=published),
        success=rates.success_plots(material),
        chunks=chunks,
        sweep=rates.chunk_sweep(material) if chunks.charts else None,
        paired=rates.paired_table(material),
        steps=rates.steps_plots(material),
        choices=choice_sections.choices(material),
        latency=machine_sections.latency(material),
        errors=machine_sections.errors_table(material),
        videos=machine_sections.videos(material),
        reproductions=[machine_sections.reproduction(run) for run in material.runs],
        # `<` is escaped as JSON does it, so that no text in it can end the element.
        report=Markup(render(material.table, "json", published=published).replace("<", "\\u003c")),
    )


def write_page(
    runs: Sequence[StoredRun],
    folder: Path,
    *,
    baseline: str | None = None,
    probes: Sequence[ProbeSection] = (),
    protocols: Sequence[str] = (),
    published: str | None = None,
) -> Path:
    """Write the page and return its path.

    Args:
        runs: as for `build_page`.
        folder: created if it does not exist.
        baseline: as for `build_page`.
        probes: as for `build_page`.
        protocols: as for `build_table`.
        published: as for `render`.

    Raises:
        ReportError: there is no episode yet, or the page cannot be written there.
        UnknownNameError: there is no such baseline.
    """
    page = build_page(
        runs, baseline=baseline, probes=probes, protocols=protocols, published=published, folder=folder
    )
    path = folder / PAGE_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8", errors="backslashreplace")  # as on standard output
    except OSError as exc:
        raise ReportError(f"{path}: cannot be written ({exc.strerror or exc}). Name another --html.") from exc
    return path


def _script_hash(script: str) -> str:
    """Return what the page's policy allows to run: this script and no other."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


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
        (sum(row[EPISODES].n_episodes for row in rows), "episodes with a result"),
        (sum(row[EPISODES].n_errors for row in rows), "errors"),
        (len(material.tasks), "tasks"),
        (len(material.colors), "policies"),
        (len(material.runs), "run folders"),
    )
    return ", ".join(f"{n} {noun if n != 1 else _singular(noun)}" for n, noun in counts)


def _singular(noun: str) -> str:
    words = {"policies": "policy", "episodes with a result": "episode with a result"}
    return words.get(noun, noun.removesuffix("s"))
