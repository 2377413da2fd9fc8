"""Execute notebooks as they stand and store what their cells show: `python scripts/notebooks.py FILE…`.

It needs no Jupyter. Each notebook is executed in a process and an empty folder of its own; of a cell, what it
prints and the value of its last line are stored, as Jupyter shows them. Standard error is not.
"""

import argparse
import ast
import contextlib
import io
import json
import linecache
import os
import subprocess
import sys
import tempfile
import types
from pathlib import Path
from typing import Any  # the JSON of a notebook

SHOWN = {"text/html": "_repr_html_", "text/markdown": "_repr_markdown_"}
"""Kind of output -> the method that gives it."""


def executed(notebook: dict[str, Any]) -> dict[str, Any]:
    """Return a notebook with the outputs of its cells, which run in this process as `__main__`."""
    main = types.ModuleType("__main__")  # as in Jupyter: classes of a notebook can be imported from nowhere
    sys.modules["__main__"] = main
    count = 0
    cells = []
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            count += 1
            outputs = _outputs("".join(cell["source"]), main, count)
            cell = {**cell, "execution_count": count, "outputs": outputs}
        cells.append(cell)
    return {**notebook, "cells": cells}


def _outputs(source: str, main: types.ModuleType, count: int) -> list[dict[str, Any]]:
    name = f"<cell {count}>"
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)  # for tracebacks
    *before, last = ast.parse(source, name).body
    value: Any = None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        if isinstance(last, ast.Expr):
            exec(compile(ast.Module(before, type_ignores=[]), name, "exec"), main.__dict__)
            value = eval(compile(ast.Expression(last.value), name, "eval"), main.__dict__)
        else:
            exec(compile(source, name, "exec"), main.__dict__)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": _lines(printed.getvalue())})
    if value is not None:
        found = {kind: getattr(value, method)() for kind, method in SHOWN.items() if hasattr(value, method)}
        data = {kind: _lines(text) for kind, text in {**found, "text/plain": repr(value)}.items()}
        outputs.append(
            {"output_type": "execute_result", "execution_count": count, "data": data, "metadata": {}}
        )
    return outputs


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def as_markdown(notebook: dict[str, Any]) -> str:
    """Return the page of a notebook: its text, its code, and below each cell what it shows."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text")})
            kind = next(kind for kind in (*SHOWN, "text/plain") if kind in data)
            text = "".join(data[kind]).rstrip()
            if kind == "text/html":
                flat = "\n".join(line.strip() for line in text.splitlines() if line.strip())
                text = f'<div class="output">\n{flat}\n</div>'
            parts.append(text if kind != "text/plain" else f"```text\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def read(path: Path) -> dict[str, Any]:
    """Return a notebook."""
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return notebook


def main() -> int:
    """Execute the notebooks that are named, each in a child, and write their outputs into them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a notebook (.ipynb)")
    parser.add_argument("--here", action="store_true", help="in this process and folder")
    args = parser.parse_args()
    for file in (path.resolve() for path in args.files):
        if args.here:
            notebook = executed(read(file))
            file.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            continue
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--here", str(file)]
            root = Path(__file__).resolve().parents[1]
            subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(root)}, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
