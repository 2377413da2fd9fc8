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
from vla_eval.base_tasks.catalog import BASE_TASKS
from vla_eval.base_tasks.row import BaseTask
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


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the pages on MIKASA-Base's families, which are generated, to the navigation."""
    pages = [{row.family: _base_page_of(row.family)} for row in _families().values()]
    for section in config.nav or []:
        if "MIKASA-Base" in section:
            section["MIKASA-Base"].append({"The environments": pages})
    return config


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
        **{_base_page_of(family): _base_page(family) for family in _families()},
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


def _families() -> dict[str, BaseTask]:
    """Return family -> its first row, in the order of the names."""
    first = {row.family: row for row in reversed(BASE_TASKS.values())}
    return {family: first[family] for family in sorted(first)}


def _base_page_of(family: str) -> str:
    return f"base/{family.lower().replace('-', '_')}.md"


def _base_page(family: str) -> str:
    """Return the page of a family: frame, rules as the code states them, levels."""
    rows = [row for row in BASE_TASKS.values() if row.family == family]
    first = rows[0]
    module = first.entry_point.partition(":")[0]
    tree = ast.parse((ROOT / Path(*module.split("."))).with_suffix(".py").read_text(encoding="utf-8"))
    classes = {
        node.name: ast.get_docstring(node) or "" for node in tree.body if isinstance(node, ast.ClassDef)
    }
    lines = [f"# {family}", "", first.description, ""]
    if (ROOT / "docs" / "images" / "base" / f"{family}.png").exists():
        shown = f"{family}: moments of an episode of the oracle, the reset first"
        lines += [f"![{shown}](../images/base/{family}.png)", ""]
    entries = dict.fromkeys(row.entry_point.partition(":")[2] for row in rows)
    for title, text in (
        ("The environment", ast.get_docstring(tree) or ""),
        *((n, classes[n]) for n in entries),
    ):
        lines += [f"## {title}", "", _as_markdown(text), ""]
    lines += [
        "## Levels",
        "",
        "| id | horizon | to be remembered | random | memoryless | best |",
        "|---|--:|---|--:|--:|--:|",
    ]
    for row in rows:
        known = (row.figures.random, row.figures.memoryless, row.figures.best)
        returns = " | ".join("—" if one is None else f"{one:g}" for one in known)
        lines.append(f"| `{row.gym_id}` | {row.horizon_steps} | {row.remember} | {returns} |")
    lines += [
        "",
        f"Returns: {first.figures.source}. Memory: {', '.join(first.memory)}; {first.tier} tier.",
        "",
    ]
    lines += [f"Success: {first.success or 'no natural rule, the score is the return.'}", ""]
    return "\n".join([*lines, f"Rules: {first.source}. [How it runs here](../mikasa_base.md)."])


def _as_markdown(text: str) -> str:
    """Return a docstring with its arguments as a list."""
    return re.sub(r"^    (\w+): ", r"- `\1`: ", text, flags=re.MULTILINE).replace("Args:\n", "Arguments:\n\n")


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
