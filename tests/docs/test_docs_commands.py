"""README and docs: each command parses and names what exists; those marked `<!-- run -->` are run.

A block that is no command to type as it stands has `<!-- not run: WHY -->` in the line above it.
"""

import argparse
import importlib
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from vla_eval.cli.main import VERBS, build_parser, main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import find_recipe, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.protocol import fill_from_protocol
from vla_eval.evaluation.model_table import is_model_table, load_model_table
from vla_eval.strict.decoding import decode
from vla_eval.tasks.arguments import check_arguments
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.mesh_folder import MESHES

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted(ROOT.glob("*/README.md")),
    ROOT / "CHANGELOG.md",
]
FENCE = re.compile(r"(?:<!-- (?P<mark>[^\n]*?) -->\n+)?```(?P<language>\w*)\n(?P<text>.*?)^```", re.M | re.S)
OTHER_PROGRAMS = ("pip", "python", "lerobot-eval", "lerobot-train", "accelerate", "pytest", "git", "curl")


class Command(NamedTuple):
    """One command line of a page; `mark` is the comment above its block."""

    page: str
    words: tuple[str, ...]
    mark: str

    @property
    def program(self) -> str:
        return Path(self.words[0]).name

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def commands(page: Path) -> Iterator[Command]:
    """Yield the command lines of a page's blocks, without comments and variables before them."""
    for block in FENCE.finditer(page.read_text(encoding="utf-8")):
        if block["language"] not in ("", "bash"):
            continue
        for line in block["text"].replace("\\\n", " ").splitlines():
            line = re.sub(r"(?:^|\s)#.*", "", line).removeprefix("PYTHONPATH=. ").strip()
            program = Path(line.partition(" ")[0]).name
            if program in ("mikasa-vla", "make", *OTHER_PROGRAMS):
                name = page.relative_to(ROOT).as_posix()
                yield Command(name, tuple(shlex.split(line)), block["mark"] or "")


ALL = [command for page in PAGES for command in commands(page)]
OURS = [one for one in ALL if one.program == "mikasa-vla" and not one.mark.startswith("not run: ")]


def is_name(text: str) -> bool:
    """Whether it is the name of something here, and neither a path nor a placeholder."""
    return "/" not in text and not text.endswith(".yaml") and not text.isupper()


def check_task(name: str, env: dict[str, Any]) -> None:
    spec = task_spec(name)
    check_arguments(spec, {name: value for name, value in env.items() if name != MESHES})  # a reader's folder


def check_names(args: argparse.Namespace) -> None:
    """Look up tasks, policies and recipes, and read what `--set` says, as the verb would do it."""
    verb = importlib.import_module(f"vla_eval.cli.{args.verb.replace('-', '_')}")
    if args.verb in ("eval", "finetune") and args.config is not None and is_model_table(args.config):
        load_model_table(args.config)  # which looks up its tasks
    elif args.verb == "eval":
        config = verb._config(args)
        for task in config.tasks:
            check_task(task, dict(config.env))
        for policy in filter(is_name, (one.partition("=")[2] or one for one in config.policies)):
            find_recipe("policies", policy)
    elif args.verb == "record":
        recipe = verb._recipe(args)
        for task in recipe.tasks:
            check_task(task, dict(recipe.env))
    elif args.verb == "finetune":
        policy = verb._config(args).policy
        assert load_recipe("policies", policy, PolicyRecipe).value.finetune is not None
    elif args.verb != "view":
        for task in [*(getattr(args, "tasks", None) or ()), *filter(None, [getattr(args, "task", None)])]:
            task_spec(task)


@pytest.mark.parametrize("command", OURS, ids=str)
def test_a_command_of_the_docs_parses_and_names_what_exists(command: Command) -> None:
    check_names(build_parser((command.words[1],)).parse_args(command.words[1:]))


def test_every_make_verb_of_the_docs_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    verbs = {one.words[1] for one in ALL if one.program == "make"}
    assert verbs <= set(re.findall(r"^([a-z0-9-]+):", makefile, re.MULTILINE))


def test_commands_of_other_programs_say_why_no_test_runs_them() -> None:
    others = [one for one in ALL if one.program in OTHER_PROGRAMS]
    assert [str(one) for one in others if not re.fullmatch(r"not run: .{10,}", one.mark)] == []


def test_verbs_and_flags_in_running_text_exist() -> None:
    wrong = []
    for page in PAGES:
        for words in re.findall(r"`mikasa-vla ([^`]+)`", page.read_text(encoding="utf-8")):
            verb = words.split()[0]
            flags = re.findall(r"(?<![\w-])--[a-z][a-z-]*", words)
            if verb != "VERB" and (verb not in VERBS or not set(flags) <= _flags(verb)):
                wrong.append(f"{page.name}: {words}")
    assert wrong == []


def test_files_named_in_running_text_exist() -> None:
    folders = "vla_eval|tests|scripts|plugins|configs|policies|datasets|prompts|docs"
    named = {
        (page.name, path)
        for page in PAGES
        for path in re.findall(rf"`((?:{folders})/[\w./]+\.[a-z]+)`", page.read_text(encoding="utf-8"))
    }
    # NAME.yaml stands for any; what is fetched or trained is no part of the repository.
    assert [one for one in sorted(named) if "NAME" not in one[1] and not (ROOT / one[1]).exists()] == []


def test_the_recipes_on_the_page_about_adding_are_read() -> None:
    page = (ROOT / "docs" / "adding.md").read_text(encoding="utf-8")
    run, dataset = (yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", page, re.S))
    for task in decode(EvalConfig, run, where="docs/adding.md").tasks:
        check_task(task, run["env"])
    assert decode(DatasetRecipe, dataset, where="docs/adding.md").tasks


def _flags(verb: str) -> set[str]:
    parsers, flags = [build_parser((verb,))], set()
    while parsers:
        for action in parsers.pop()._actions:
            flags.update(action.option_strings)
            if isinstance(action, argparse._SubParsersAction):
                parsers.extend(action.choices.values())
    return flags


MARKED = [one for one in OURS if one.mark == "run"]
STAND_INS = ("DIR", *(f"runs/{name}" for name in ("shell", "intercept", "color3", "color5", "color9")))
TRAININGS = tuple(f"runs/seed{number}" for number in range(3))
CONTENTS = {
    "docs/tutorial.md": {"list", "show", "eval", "report", "compare"},
    "docs/your_checkpoint.md": {"checkpoint", "check", "eval", "report"},
}
"""Pages whose commands are run in their order -> verbs that are among them."""


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("page", CONTENTS)
def test_the_marked_commands_of_a_page_run_on_the_fake_simulator(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    marked = [one for one in MARKED if one.page == page]
    assert {one.words[1] for one in marked} >= CONTENTS[page]
    monkeypatch.chdir(tmp_path)
    for name in (*STAND_INS, *TRAININGS):  # the page's checkpoints: each another one
        shutil.copytree(ROOT / "checkpoints" / "memory_color3", name)
        (Path(name) / "name.txt").write_text(name)
    for command in marked:
        words = [*command.words[1:], *(_small(command) if command.words[1] == "eval" else ())]
        assert main(words) == 0, f"{command}\n{capsys.readouterr().err}"
        assert capsys.readouterr().out


def _small(command: Command) -> tuple[str, ...]:
    one_row = ("--task", "RememberColor3-v0", "--set", "n_action_steps=[4]")
    is_large = "--protocol" in command.words
    return ("--episodes", "2", "--workers", "1", "--set", "simulator=fake", *(one_row if is_large else ()))


def test_each_marked_command_is_on_a_page_that_is_run() -> None:
    assert {one.page for one in MARKED} == set(CONTENTS)


def test_the_configuration_of_the_page_about_your_checkpoint_is_read() -> None:
    page = (ROOT / "docs" / "your_checkpoint.md").read_text(encoding="utf-8")
    (data,) = (yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", page, re.S))
    fill_from_protocol(data)
    config = decode(EvalConfig, data, where="docs/your_checkpoint.md")
    assert {f"mine:{task}" for task in config.tasks} == {one.partition("=")[0] for one in config.policies[:5]}
    assert set(re.findall(r"runs/\w+", " ".join(config.policies))) < {*STAND_INS, *TRAININGS}
