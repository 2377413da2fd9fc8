"""Open a file of another program: the one door for results that were counted elsewhere."""

from pathlib import Path

from vla_eval.errors import ReportError
from vla_eval.results.imported.programs import PROGRAMS
from vla_eval.results.imported.rows import ImportedRow
from vla_eval.strict.json_text import Source, loads, read_file


def read_imported(path: Path) -> tuple[ImportedRow, ...]:
    """Return the rows of a file, by what is in it; its name does not matter.

    Raises:
        ReportError: there is no such file, it is of no known program, its fields are not those of its
            program, or its own figures are not those of its episodes.
    """
    known = "; ".join(f"{one.name}: {one.file}" for one in PROGRAMS)
    source = Source(
        where=str(path),
        what="results of another program",
        remedy=f"Files that are read: {known}.",
        error=ReportError,
    )
    try:
        content = read_file(path, source)
    except (FileNotFoundError, NotADirectoryError) as exc:
        raise ReportError(f"{path}: there is no such file. {source.remedy}") from exc
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as exc:
        raise source.refuse("bytes that are not UTF-8", exc) from exc
    rows = _rows(text, source)
    if not rows:
        raise source.refuse("no task with an episode", "there is nothing to import")
    return rows


def _rows(text: str, source: Source) -> tuple[ImportedRow, ...]:
    for program in PROGRAMS:
        if program.read_text is not None and program.is_text(text):
            return tuple(program.read_text(text, source))
    try:
        data = loads(text, lone_surrogates=True, non_finite=True)
    except ValueError as exc:
        raise source.refuse("neither JSON nor a log that is known", exc) from exc
    for program in PROGRAMS:
        if program.read_json is not None and isinstance(data, dict) and program.keys <= data.keys():
            return tuple(program.read_json(data, source))
    raise source.refuse("JSON of none of them", "its fields are those of no known program")
