"""A folder that holds a module of every name: no process that a verb starts may import one of them."""

import argparse
import contextlib
import functools
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

import pytest

from tests.cli.every_verb import (
    COMMANDS,
    ENDLESS,
    FAKE,
    REFUSED,
    ROOT,
    TASK,
    command_line,
    environment_of,
    verb_of,
)
from vla_eval.cli.main import build_parser

TRAP = """
import os, sys
with open({mark!r}, "a") as file:
    file.write(f"{{os.getpid()}} {name} " + " ".join(sys.orig_argv)[:120].replace("\\n", " ") + "\\n")
before, here = sys.path[:], os.path.dirname(os.path.abspath(__file__))
sys.path[:] = [entry for entry in before if os.path.abspath(entry or ".") != here]
sys.modules.pop(__name__, None)
__import__(__name__)  # the real one: what is started lives on, to be caught again
sys.path[:] = before
"""
HANGS_AFTER_S = 600.0

WITH_LEROBOT = {
    *("record", "replay", "finetune", "train-agent", "doctor", "bench --loader", "bench --serve"),
    *("checkpoint verify", "checkpoint rehearse", "checkpoint merge"),
    *("checkpoint convert-octo", "checkpoint convert-openvla", "checkpoint convert-spatialvla"),
    *("view", "serve", "real", "real --teleop"),
    *(name for name in COMMANDS if name.startswith("dataset ")),
}
"""Commands that import lerobot, which takes 10 s, or read what those have made."""
STARTED_ALIKE = {"bench --loader", "bench --serve", "probe"}
"""Commands whose processes are those of `finetune`, `eval --serve` and `eval`."""
ENDED = "This command ended with "
FORKED = "This command runs in process "
# What an earlier command has imported is not searched for again, and springs no trap: look at each import.
ONE_AFTER_ANOTHER = f"""
import builtins, json, os, sys
from vla_eval.cli.main import main

def import_and_look(*args, **kwargs):
    if here.intersection(sys.path):
        print("searches the working directory:", sys.path, args[0], flush=True)
        os._exit(70)
    return really_import(*args, **kwargs)

def code_of(command):
    try:
        return main(command.split())
    except SystemExit as ends:
        return ends.code

if __name__ == "__main__":
    here, really_import = {{"", ".", os.getcwd()}}, builtins.__import__
    builtins.__import__ = import_and_look
    commands = os.fdopen(os.dup(0))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for line in commands:
        is_endless, command = json.loads(line)
        if not is_endless:
            code = code_of(command)
        elif pid := os.fork():  # it has what the commands before it have imported
            print("{FORKED}", pid, flush=True)
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        else:
            code = code_of(command)
            sys.stdout.flush()
            os._exit(code)
        print("{ENDED}", code, flush=True)
"""


@functools.cache
def installed_modules() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


class Traps:
    """The folder, and what was caught in it."""

    def __init__(self, folder: Path, *, with_standard_library: bool = True) -> None:
        self.work, self.folder, self._mark = folder / "work", folder / "traps", folder / "mark"
        self.work.mkdir()
        self.folder.mkdir()
        installed = set(installed_modules())
        own = {"sitecustomize", "usercustomize", "vla_eval"} | sys.stdlib_module_names
        for name in installed | (own if with_standard_library else {"multiprocessing", "selectors"}):
            if name.isidentifier():
                (self.folder / f"{name}.py").write_text(TRAP.format(mark=str(self._mark), name=name))

    def caught(self) -> dict[int, str]:
        """Return process id -> the first module that it imported from here, and what it was started as."""
        lines = self._mark.read_text().splitlines() if self._mark.exists() else []
        self._mark.unlink(missing_ok=True)
        return {int(pid): what for pid, _, what in (line.partition(" ") for line in reversed(lines))}

    def run(self, command: str, **environment: str) -> tuple[int, int, str]:
        """Return process id, exit code and output of a command."""
        with self.started(command_line(command, self.work), **environment) as process:
            assert process.stdout is not None
            said = process.stdout.read()
            return process.pid, process.wait(), said

    def program(self, text: str) -> list[str]:
        """Return what starts a program from a folder elsewhere, as a command is started."""
        interpreter, command = command_line("", self.work)
        program = Path(command).with_name("program")
        program.write_text(text)
        return [interpreter, str(program)]

    @contextlib.contextmanager
    def one_process(self) -> Iterator[Callable[[str, str | None], tuple[int, str]]]:
        """Start a process; the function that it yields has it run a command, and returns code and output.

        A command that does not end runs in a fork, and is stopped when it has printed a word.
        """
        with self.started(self.program(ONE_AFTER_ANOTHER), stdin=subprocess.PIPE) as process:
            asked, answers = process.stdin, process.stdout
            assert asked is not None and answers is not None

            def run(command: str, until: str | None) -> tuple[int, str]:
                asking = (until is not None, command.replace("{W}", str(self.work)))
                print(json.dumps(asking), file=asked, flush=True)
                said, pid = "", 0
                for line in answers:
                    before, ended, code = line.partition(ENDED)
                    said += before
                    if line.startswith(FORKED):
                        pid = int(line.removeprefix(FORKED))
                    elif ended:
                        return int(code), said
                    elif until is not None and until in line:
                        os.kill(pid, signal.SIGTERM)
                raise AssertionError(f"{command}: the process has ended: {said}")

            yield run

    @contextlib.contextmanager
    def started(
        self, command: list[str], *, stdin: int = subprocess.DEVNULL, **environment: str
    ) -> Iterator[subprocess.Popen[str]]:
        with subprocess.Popen(
            command,
            cwd=self.folder,
            env=environment_of(self.work, **environment),
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            alarm = threading.Timer(HANGS_AFTER_S, process.kill)
            alarm.start()
            try:
                yield process
            finally:
                alarm.cancel()


@pytest.fixture
def traps(tmp_path: Path) -> Traps:
    return Traps(tmp_path)


def verbs(parser: argparse.ArgumentParser, above: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    """Return every verb, and every action of those that have some."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return set().union(*(verbs(below, (*above, name)) for name, below in action.choices.items()))
    return {above}


def test_there_is_a_command_of_every_verb() -> None:
    assert {verb_of(name) for name in COMMANDS} == verbs(build_parser())


def named(*, with_lerobot: bool) -> list[str]:
    """Return the commands of one of the two processes that run them one after another.

    Those that do not end come last: they need the most imports, and find them there.
    """
    own = {name for name in COMMANDS if (name in WITH_LEROBOT) is with_lerobot}
    return sorted((name for name in COMMANDS if name in own - STARTED_ALIKE), key=ENDLESS.__contains__)


@pytest.mark.parametrize(
    ("names", "each_alone"),
    [
        pytest.param(named(with_lerobot=True), set(), id="with lerobot", marks=pytest.mark.slow),
        pytest.param(named(with_lerobot=False), set(), id="without it"),
        pytest.param(COMMANDS.keys(), COMMANDS.keys() - WITH_LEROBOT, id="all", marks=pytest.mark.slow),
    ],
)
def test_no_process_of_any_verb_imports_from_the_working_directory(
    traps: Traps, names: Collection[str], each_alone: Collection[str]
) -> None:
    """One process, started as a command is, runs them; those that do not end run in a fork of it."""
    caught = {}
    with traps.one_process() as run_there:
        for name in names:
            command = COMMANDS[name]
            if name in each_alone:
                _, code, said = traps.run(command)
            else:
                code, said = run_there(command, ENDLESS.get(name))
            if name in ENDLESS:
                assert ENDLESS[name] in said, f"{name}: {said}"
            else:
                assert code == (1 if name in REFUSED else 0), f"{name}: {said}"
            if found := traps.caught():
                caught[name] = sorted(found.values())
    assert caught == {}


STARTS_OTHERS = """
import subprocess, sys
from vla_eval.cli.main import main
from vla_eval.workers.children import python_command
from vla_eval.workers.start import child_context

if __name__ == "__main__":
    assert main(["list", "tasks"]) == 0
    child = child_context().Process(target=print, args=("a child imports vla_eval",))
    child.start()
    child.join()
    assert child.exitcode == 0
    for start in (python_command, lambda *rest: [sys.executable, *rest]):  # ours; a library's own
        subprocess.run(start("-c", "import json, numpy, vla_eval.errors"), check=True)
"""


def test_no_process_of_any_kind_that_verbs_start_imports_from_the_working_directory(traps: Traps) -> None:
    """Workers are those of the commands above; here: loaders, what `doctor` starts, what a library starts."""
    with traps.started(traps.program(STARTS_OTHERS)) as process:
        assert process.stdout is not None
        said = process.stdout.read()
    assert (process.returncode, traps.caught()) == (0, {}), said


@pytest.mark.slow
@pytest.mark.parametrize(
    "search_path",
    [
        pytest.param(f":{ROOT}::{ROOT}:", id="everywhere"),
        *(
            pytest.param(path, id=name, marks=pytest.mark.slow)
            for name, path in {"last": f"{ROOT}:", "first": f":{ROOT}", "mid": f"{ROOT}::{ROOT}"}.items()
        ),
    ],
)
def test_an_empty_entry_of_pythonpath_is_not_the_working_directory_of_children(
    search_path: str, tmp_path: Path
) -> None:
    """Of the command itself it is: a trapped standard library ends the interpreter before we are asked."""
    traps = Traps(tmp_path, with_standard_library=False)
    pid, code, said = traps.run(COMMANDS["eval"], PYTHONPATH=search_path)
    assert code == 0, said
    caught = traps.caught()
    caught.pop(pid, None)
    assert caught == {}


@pytest.mark.slow
def test_a_folder_that_pythonpath_names_is_searched_also_if_it_is_the_working_directory(
    tmp_path: Path,
) -> None:
    """As docs/policies.md has it: by the command, and by the worker process."""
    (tmp_path / "my_policy.py").write_text(
        "import os\nfrom pathlib import Path\n"
        "from vla_eval.policies.controls.scripted import make_cue_blind\n"
        "def make(context):\n"
        "    Path(__file__).with_name(f'made-by-{os.getpid()}').touch()\n"
        "    return make_cue_blind(context)\n"
    )
    (tmp_path / "my_policy.yaml").write_text("version: 1\ndescription: mine\nadapter: my_policy:make\n")
    for search_path in (".", f"{ROOT}{os.pathsep}{tmp_path}"):
        out = tmp_path / f"run-{len(search_path)}"
        command = f"eval --task {TASK} --policy my_policy.yaml --episodes 1 {FAKE} --out {out}"
        environment = environment_of(tmp_path, PYTHONPATH=f"{search_path}{os.pathsep}{ROOT}")
        process = subprocess.run(
            command_line(command, tmp_path), cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert process.returncode == 0, process.stderr
    assert len(list(tmp_path.glob("made-by-*"))) >= 2
