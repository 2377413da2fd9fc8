"""Published results as tables below a success table: the rates, and how they were measured."""

from collections.abc import Iterator, Sequence
from functools import partial

from vla_eval.config.files import to_data
from vla_eval.results.passport.ranking import APART, standing_letters
from vla_eval.results.printed_table import UNDEFINED, Column, SideTable, cells_of
from vla_eval.results.published.literature import (
    DIGEST,
    PaperFigure,
    Published,
    PublishedResult,
    load_published,
    paper_figures,
)
from vla_eval.results.published.passports import passport_of_published
from vla_eval.results.success_table import Table

ALL_APART = f"{APART}: no two rows are known to have been measured alike, so none are ranked."
LETTERS = (
    "ranked with: rows with the same letter agree in each setting that is stated, and stand in one table of "
    f"one source. {APART}: a setting differs, or is unknown (`mikasa-vla passport` says which)."
)
CONTESTED, COMPUTED, PERHAPS = "‡", "(computed)", "perhaps"
PAPER_SOURCE = "“Memory, Benchmark & Robots” (ICLR 2026), appendix “VLA baselines”, table of VLA models"
NO_FIGURES = "The paper's table of VLA models has none of these tasks."
PAPER_PROTOCOL = "mean ± SEM, 3 runs × 100 episodes"


def published_side_tables(board: str) -> list[SideTable]:
    """Return a board's published results and how they were measured; errors as `of_board`."""
    published = load_published()
    results = published.of_board(board)
    tasks = published.boards[board].tasks
    columns: list[Column[PublishedResult]] = [
        Column("method (published)", lambda one: one.label, is_number=False),
        Column("K", partial(_stated, "n_action_steps")),
        *(Column(task.removesuffix("-v0"), partial(_rate, task)) for task in tasks),
        Column("mean", partial(_mean, published)),
    ]
    rates = SideTable(
        title=f"Published results, not measured here unless marked: {published.boards[board].title}",
        columns=columns,
        rows=cells_of(columns, results),
        notes=list(_notes(published, results)),
        csv_columns=("reference", "contested"),
        csv_rows=[row for one in results for row in _csv_rows(published, one)],
        json={"published": {"board": board, "checked": published.checked, "rows": _json(published, results)}},
    )
    return [rates, _how_measured(published, results)]


def paper_side_table(table: Table) -> SideTable:
    """Return the paper's results of VLA models for the tasks of a table."""
    tasks = dict.fromkeys(row.task for row in table.rows)
    figures = [figure for task in tasks for figure in paper_figures() if figure.task == task]
    fields = [one._asdict() for one in figures]
    return SideTable(
        title=f"The paper's figures, not measured here ({PAPER_PROTOCOL})",
        columns=_PAPER_COLUMNS,
        rows=cells_of(_PAPER_COLUMNS, figures),
        notes=[f"Source: {PAPER_SOURCE}." if figures else NO_FIGURES],
        csv_rows=[{"source": "paper", "policy": one["model"], **one} for one in fields],
        json={"paper": {"source": PAPER_SOURCE, "protocol": PAPER_PROTOCOL, "rows": fields}},
    )


_PAPER_COLUMNS: tuple[Column[PaperFigure], ...] = (
    Column("task", lambda one: one.task, is_number=False),
    Column("model (paper)", lambda one: one.model, is_number=False),
    Column("K", lambda one: str(one.n_action_steps)),
    Column("success once (paper)", lambda one: f"{one.success_once:.2f} ± {one.sem:.2f}"),
)


def _how_measured(published: Published, results: Sequence[PublishedResult]) -> SideTable:
    titles = {name: source.title for name, source in published.sources.items()}
    passports = [passport_of_published(one, published) for one in results]
    letters = dict(zip(map(id, results), standing_letters(passports), strict=True))
    columns: list[Column[PublishedResult]] = [
        Column("method", lambda one: one.label, is_number=False),
        Column("ranked with", lambda one: letters[id(one)] or APART, is_number=False),
        Column("kind", partial(_stated, "family"), is_number=False),
        Column("source", lambda one: ", ".join(filter(None, (titles[one.source], one.where))), False),
        Column("tasks of", partial(_stated, "suite"), is_number=False),
        Column("control mode", partial(_stated, "control_mode"), is_number=False),
        Column("image (px)", partial(_stated, "image_px")),
        Column("models", partial(_stated, "training"), is_number=False),
        Column("runs", partial(_stated, "runs")),
        Column("episodes", partial(_stated, "episodes")),
        Column("seeds", partial(_stated, "seeds"), is_number=False),
    ]
    return SideTable(
        title="How the published results were measured, as far as the sources say",
        columns=columns,
        rows=cells_of(columns, results),
        notes=[LETTERS] if any(letters.values()) else [ALL_APART],
        json={"published_passports": [{"method": one.subject, **one.to_dict()} for one in passports]},
    )


def _rate(task: str, result: PublishedResult) -> str:
    found = result.rates.get(task)
    if found is None:
        return UNDEFINED
    spread = "" if found.spread is None else f" ± {found.spread:.2f}"
    return f"{found.rate:.2f}{spread}{f' {CONTESTED}' if task in result.contested else ''}"


def _mean(published: Published, result: PublishedResult) -> str:
    mean = published.mean_of(result)
    if mean is None:
        return UNDEFINED
    stated = result.mean
    spread = "" if stated is None or stated.spread is None else f" ± {stated.spread:.3f}"
    marks = [*([COMPUTED] if stated is None else []), *([CONTESTED] if result.contested else [])]
    return " ".join([f"{mean:.3f}{spread}", *marks])


def _notes(published: Published, results: Sequence[PublishedResult]) -> Iterator[str]:
    if any(one.mean is None and published.mean_of(one) is not None for one in results):
        yield f"{COMPUTED}: mean of the rates in the row; the source states none."
    for kind in dict.fromkeys(one.spread for one in results if one.spread):
        yield f"±: {kind}, where the source states it."
    if any(one.read == "digest" for one in results):
        yield f"{DIGEST}: read in digests; the source itself could not be read."
    if any(one.perhaps for one in results):
        yield f"{PERHAPS}: inferred from what was read elsewhere, not stated for this figure; see its note."
    for one in results:
        for task, text in one.contested.items():
            yield f"{CONTESTED} contested: {one.method} on {task}, {text}."
    for one in results:
        k = "" if one.n_action_steps is None else f" at K = {one.n_action_steps}"
        perhaps = [f"{PERHAPS} {_words(name)}: {text}" for name, text in one.perhaps.items()]
        if perhaps or one.differs:
            yield f"{one.label}{k}: {'; '.join((*perhaps, *one.differs))}."


def _csv_rows(published: Published, result: PublishedResult) -> Iterator[dict[str, object]]:
    common: dict[str, object] = {
        "source": "measured here, not in these runs" if result.is_measured_here else "published",
        "policy": result.method,
        "n_action_steps": result.n_action_steps,
        "reference": published.sources[result.source].title,
    }
    for task, found in result.rates.items():
        contested = result.contested.get(task)
        cells = {"task": task, "success_once": found.rate, "sem": found.spread, "contested": contested}
        yield common | cells
    if (mean := published.mean_of(result)) is not None:
        spread = result.mean.spread if result.mean is not None else None
        yield common | {"task": f"mean of {result.board}", "success_once": mean, "sem": spread}


def _json(published: Published, results: Sequence[PublishedResult]) -> list[dict[str, object]]:
    rows = []
    for one in results:
        reference = to_data(published.sources[one.source])
        rows.append({**to_data(one), "source": reference, "mean_over_tasks": published.mean_of(one)})
    return rows


def _stated(name: str, result: PublishedResult) -> str:
    """Return a field as the source states it, or the mark of what is inferred, or of what is unknown."""
    value = getattr(result, name)
    if value is not None:
        return str(value)
    return PERHAPS if name in result.perhaps else UNDEFINED


def _words(name: str) -> str:
    return {"n_action_steps": "K", "suite": "tasks"}.get(name, name)
