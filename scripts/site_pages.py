"""Generate pages of the documentation from the code when the site is built; a hook of MkDocs.

They are not committed, so they cannot be out of date: the command line from its argparse parsers, the
tasks from the catalogue, the tables of recipes from the READMEs beside them, the list of modules from their
first lines, the changelog, the notebooks with their outputs. The pages `docs/reference/api/*.md` name
modules; mkdocstrings fills them from docstrings. It knows nothing of how pages look, and imports neither
torch nor a simulator.
"""

import argparse
import ast
import contextlib
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any  # MkDocs passes what this hook does not use
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from scripts.notebooks import as_markdown, read
from vla_eval.cli import show
from vla_eval.cli.main import PROGRAM, build_parser
from vla_eval.config.prompts import DEFAULT_PROMPT_SET
from vla_eval.tasks.catalog import FAMILIES, TASKS

ROOT = Path(__file__).parents[1]
RECIPE_FOLDERS = ("configs", "policies", "datasets", "prompts", "protocols")
API_FOLDER = "reference/api"
DOCUMENTED = re.compile(r"^::: (vla_eval[\w.]*)$", re.MULTILINE)
NOTEBOOK_LINK = re.compile(r"(\]\([^()\s]+)\.ipynb\)")
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
HELP_COLUMNS = "82"  # what the column of a page shows without scrolling


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those of docs/."""
    for path, text in generated_pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lead links to notebooks to their pages."""
    return NOTEBOOK_LINK.sub(r"\1.md)", markdown)


def generated_pages() -> dict[str, str]:
    """Return path in the site -> Markdown."""
    return {
        "reference/cli.md": _command_line(),
        "reference/tasks.md": _tasks(),
        f"{API_FOLDER}/rooms.md": _rooms(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        **{f"notebooks/{file.stem}.md": as_markdown(read(file)) for file in NOTEBOOKS},
        **{f"reference/{folder}.md": _recipes(folder) for folder in RECIPE_FOLDERS},
    }


def _command_line() -> str:
    lines = [
        "# The command line",
        "",
        f"Each verb as `{PROGRAM} VERB --help` prints it. Flags are never abbreviated.",
        "",
    ]
    with mock.patch.dict(os.environ, {"COLUMNS": HELP_COLUMNS}):
        for parser in _with_actions(build_parser()):
            depth = 2 if parser.prog.count(" ") < 2 else 3
            lines += [f"{'#' * depth} `{parser.prog}`", "", *_printed(parser.format_help())]
    return "\n".join(lines)


def _with_actions(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield a parser, then those of its verbs, and of their actions."""
    yield parser
    for action in parser._actions:  # argparse has no public way to ask for the parsers of verbs
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _with_actions(sub)


def _tasks() -> str:
    lines = ["# Every task, as `show` prints it", "", "[All tasks](../tasks.md) explains the arguments.", ""]
    for title, specs in (("Tasks", TASKS), ("Families", FAMILIES)):
        lines += [f"## {title}", ""]
        for name in specs:
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                show.run(argparse.Namespace(name=name, prompt_set=DEFAULT_PROMPT_SET))
            lines += [f"### {name}", "", *_printed(printed.getvalue())]
    return "\n".join(lines)


def _rooms() -> str:
    """Return every module of the package with the first line of its docstring, room by room."""
    pages = {
        module: page.name
        for page in sorted((ROOT / "docs" / API_FOLDER).glob("*.md"))
        for module in DOCUMENTED.findall(page.read_text(encoding="utf-8"))
    }
    lines = [
        "# Every module, by room",
        "",
        "A room is a folder of `vla_eval` with one subject. Modules with a link are for use from Python and "
        "have a reference; the others may change in any version.",
        "",
    ]
    package = ROOT / "vla_eval"
    rooms = sorted(path.parent for path in package.rglob("__init__.py"))
    for room in rooms:
        name = ".".join(room.relative_to(ROOT).parts)
        files = [file for file in sorted(room.glob("*.py")) if not file.name.startswith("__")]
        if not files:
            continue
        lines += [f"## `{name}`", "", _first_line(room / "__init__.py"), "", "| module | what it does |"]
        lines += ["|---|---|"]
        for file in files:
            module = f"{name}.{file.stem}"
            linked = f"[`{file.stem}`]({pages[module]}#{module})" if module in pages else f"`{file.stem}`"
            lines.append(f"| {linked} | {_first_line(file)} |")
        lines.append("")
    return "\n".join(lines)


def _first_line(file: Path) -> str:
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    return (docstring or "").partition("\n")[0].replace("|", "\\|").replace("<", "&lt;")


def _printed(text: str) -> list[str]:
    return ["```text", text.rstrip(), "```", ""]


def _recipes(folder: str) -> str:
    text = (ROOT / folder / "README.md").read_text(encoding="utf-8")
    return text.replace("](../docs/", "](../")
