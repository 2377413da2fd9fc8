"""Build the report page: one HTML file that needs nothing else. Reads and returns; it draws no numbers."""

from collections.abc import Sequence
from pathlib import Path

from vla_eval import __version__
from vla_eval.errors import ReportError
from vla_eval.page.choice_sections import choices_section
from vla_eval.page.machine_sections import (
    episodes_section,
    errors_section,
    latency_section,
    reproduction_section,
)
from vla_eval.page.markup import Markup, element, joined, paragraph
from vla_eval.page.material import Material, gather
from vla_eval.page.rates import chunk_section, paired_section, steps_section, success_section, table_section
from vla_eval.results.store import StoredRun
from vla_eval.results.table_formats import render

PAGE_FILE = "index.html"
STYLE = Path(__file__).with_name("page.css")
# The browser itself refuses whatever is not in the file.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
LINKS = (
    ("table", "Results"),
    ("success", "By task"),
    ("chunks", "By K"),
    ("paired", "Paired"),
    ("steps", "Steps"),
    ("choices", "Choices"),
    ("latency", "Latency"),
    ("errors", "Errors"),
    ("episodes", "Episodes"),
    ("reproduce", "To do it again"),
)


def build_page(runs: Sequence[StoredRun], *, baseline: str | None = None) -> str:
    """Return the page of one or more runs; the same runs give the same bytes.

    Args:
        runs: what the run folders hold. Timings and videos are read from the folders themselves.
        baseline: as for `build_table`.

    Raises:
        ReportError: there is no episode yet.
        UnknownNameError: there is no such baseline.
    """
    material = gather(runs, baseline=baseline)
    title = "Evaluation: " + ", ".join(dict.fromkeys(run.description.name for run in material.runs))
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=POLICY),
        element("title", title),
        element("style", Markup(STYLE.read_text(encoding="utf-8"))),
        # A picture of its own, or the browser would ask for one.
        Markup('<link rel="icon" href="data:,"/>'),
    )
    body = element("body", element("main", *_content(material, title)), _report_data(material))
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def write_page(runs: Sequence[StoredRun], folder: Path, *, baseline: str | None = None) -> Path:
    """Write the page and return its path.

    Args:
        runs: as for `build_page`.
        folder: it is made if it is not there.
        baseline: as for `build_page`.

    Raises:
        ReportError: there is no episode yet, or the page cannot be written there.
        UnknownNameError: there is no such baseline.
    """
    page = build_page(runs, baseline=baseline)
    path = folder / PAGE_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as exc:
        raise ReportError(f"{path}: cannot be written ({exc.strerror or exc}). Name another --html.") from exc
    return path


def _content(material: Material, title: str) -> list[Markup]:
    links = [element("li", element("a", name, href=f"#{anchor}")) for anchor, name in LINKS]
    return [
        element("h1", title),
        paragraph(_summary(material), muted=True),
        element("nav", element("ul", *links), aria_label="Sections"),
        table_section(material),
        success_section(material),
        chunk_section(material),
        paired_section(material),
        steps_section(material),
        choices_section(material),
        latency_section(material),
        errors_section(material),
        episodes_section(material),
        reproduction_section(material),
    ]


def _summary(material: Material) -> str:
    rows = material.table.rows
    counts = (
        (sum(row.n_episodes for row in rows), "episodes with a result"),
        (sum(row.n_errors for row in rows), "errors"),
        (len(material.tasks), "tasks"),
        (len(material.colors), "policies"),
        (len(material.runs), "run folders"),
    )
    said = ", ".join(f"{n} {noun if n != 1 else _singular(noun)}" for n, noun in counts)
    return f"{said}. Written by mikasa-vla-eval {__version__}."


def _singular(noun: str) -> str:
    words = {"policies": "policy", "episodes with a result": "episode with a result"}
    return words.get(noun, noun.removesuffix("s"))


def _report_data(material: Material) -> Markup:
    """Return the JSON report, to be read by programs; `<` is escaped, so that it cannot end the element."""
    data = render(material.table, "json").replace("<", "\\u003c")
    return element("script", joined([Markup(data)]), type="application/json", id="report")
