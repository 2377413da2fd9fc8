"""Write `docs/results.schema.json`, the schema of `report --export`, and the tables of `docs/exported.md`.

Usage: .venv/bin/python scripts/results_schema.py [DOCS_FOLDER]
"""

import json
import sys
from pathlib import Path

from vla_eval.results.exported.file import ROW_FIELDS, export_schema
from vla_eval.results.passport.fields import FIELDS

SCHEMA, PAGE, START = "results.schema.json", "exported.md", "<!-- generated: scripts/results_schema.py -->"


def tables() -> str:
    """Return the fields of a row and of its passport, as the page has them."""
    rows = [f"| `{one.name}` | {one.words} |" for one in ROW_FIELDS]
    passport = [f"| `{one.name}` | {one.words} |" for one in FIELDS]
    head = ["| field | |", "|---|---|"]
    lines = [*head, *rows, "", "Of `passport`, text, a list of texts, or null:", "", *head, *passport]
    return "\n".join(lines) + "\n"


def schema_text() -> str:
    """Return the schema's file."""
    return json.dumps(export_schema(), indent=2, ensure_ascii=False) + "\n"


def page(text: str) -> str:
    """Return the page with its tables renewed."""
    return text.partition(START)[0] + START + "\n\n" + tables()


def main() -> None:
    """Write both."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs")
    (folder / SCHEMA).write_text(schema_text(), encoding="utf-8")
    file = folder / PAGE
    file.write_text(page(file.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
