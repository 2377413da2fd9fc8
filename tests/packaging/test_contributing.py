"""CONTRIBUTING is as the code is: what it names exists, and each of its recipes is walked by a test."""

import argparse
import ast
import dataclasses
import importlib
import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from vla_eval.cli import main as cli
from vla_eval.data.checks import rules
from vla_eval.data.checks.demonstrated import Demonstrations
from vla_eval.errors import DatasetError, RecipeError

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
RECIPES = ("Add a task", "Add a policy", "Add a statistic", "Add a rule for datasets", "Add a verb")
PLACEHOLDERS = ("policies/NAME.yaml",)
WALKED = re.compile(r"^Walked by `(?P<file>tests/[\w/]+\.py)::(?P<test>\w+)`\.$", re.MULTILINE)


def section(title: str) -> str:
    return TEXT.partition(f"## {title}\n")[2].partition("\n## ")[0]


def test_each_path_that_it_names_exists() -> None:
    named = re.findall(r"`([\w.-]+(?:/[\w.-]+)+/?)`|\]\(([\w./-]+\.md)", TEXT)
    paths = {one or other for one, other in named} - set(PLACEHOLDERS)
    assert len(paths) > 20
    assert [path for path in sorted(paths) if not _exists(path)] == []


def _exists(path: str) -> bool:
    # `cli/main.py` is short for the file in the package.
    return (ROOT / path).exists() or (ROOT / "vla_eval" / path).exists()


def test_each_dotted_name_and_class_that_it_names_exists() -> None:
    for dotted in re.findall(r"`(vla_eval(?:\.\w+)+)`", TEXT):
        module, _, name = dotted.rpartition(".")
        assert importlib.util.find_spec(dotted) or hasattr(importlib.import_module(module), name), dotted
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "vla_eval").rglob("*.py"))
    for name in set(re.findall(r"`([A-Z]\w+[a-z]\w*)`", TEXT)) - {"None"}:
        assert re.search(rf"^class {name}\b", source, re.MULTILINE), name


@pytest.mark.parametrize("title", RECIPES)
def test_each_recipe_is_walked_by_a_test(title: str) -> None:
    found = WALKED.findall(section(title))
    assert len(found) == 1, title
    file, name = found[0]
    functions = {
        node.name
        for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    }
    assert name in functions


def test_there_is_no_other_recipe() -> None:
    assert re.findall(r"^## (Add .*)$", TEXT, re.MULTILINE) == list(RECIPES)


def test_a_rule_for_datasets_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def check(what: Demonstrations) -> Iterator[str]:
        if len(what.names) % 2:
            yield f"There are {len(what.names)} episodes, expected an even number."

    row = rules.Rule(name="pairs of episodes", answer="refused", check=check, remedy="Record one more.")
    monkeypatch.setattr(rules, "RULES", (*rules.RULES, row))
    even = Demonstrations(
        where=Path("toy"),
        fps=20,
        names=("one", "two"),
        lengths=(2, 2),
        columns={},
        dims={},
        sentences=("go",) * 4,
        action=None,
        image_sizes_px={},
    )
    assert "even number" not in " ".join(rules.require_sound(even))
    odd = dataclasses.replace(even, names=("one",), lengths=(2,), sentences=("go",) * 2)
    with pytest.raises(DatasetError, match=r"toy: There are 1 episodes, .* Record one more\."):
        rules.require_sound(odd)


def test_a_verb_is_a_file_and_a_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toy = ModuleType("vla_eval.cli.greet")

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--whom", required=True)

    def run(args: argparse.Namespace) -> int:
        if not args.whom.strip():
            raise RecipeError("--whom: expected a name, found only blanks. Name somebody.")
        print(f"hello {args.whom}")
        return 0

    vars(toy).update(add_arguments=add_arguments, run=run)
    monkeypatch.setitem(sys.modules, toy.__name__, toy)
    monkeypatch.setattr(cli, "VERBS", {**cli.VERBS, "greet": "say hello"})
    assert cli.main(["greet", "--whom", "robot"]) == 0
    assert capsys.readouterr().out == "hello robot\n"
    assert cli.main(["greet", "--whom", " "]) == 1
    assert capsys.readouterr().err == (
        "mikasa-vla: error: --whom: expected a name, found only blanks. Name somebody.\n"
    )
    with pytest.raises(SystemExit, match="1"):
        cli.main(["greet", "--who", "robot"])
    assert "greet" in capsys.readouterr().err
