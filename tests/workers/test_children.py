"""How this program starts other processes, and that they do not import from the working directory."""

import ast
import os
import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.every_verb import EVAL
from vla_eval.workers.children import bound_command, python_command
from vla_eval.workers.start import child_context

ROOT = Path(__file__).parents[2]
STARTING = {"vla_eval/workers/children.py", "vla_eval/workers/start.py"}
STARTERS = {
    *("sys.executable", "'python'", "'python3'", "os.fork", "os.posix_spawn", "os.system", "os.popen"),
    *(f"multiprocessing.{name}" for name in ("get_context", "Process", "Pool", "Manager")),
}
NAMING = {
    "vla_eval/workers/guard.py": "os.fork",  # a fork has its parent's modules
    "scripts/notebooks.py": "sys.executable",  # a notebook's own process
    "vla_eval/lock/events.py": "sys.executable",  # to know it where a program is refused
}


def sources() -> Iterator[tuple[str, ast.AST]]:
    for folder in ("vla_eval", "scripts", "plugins"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text())


def test_python_is_started_by_the_functions_of_workers_alone() -> None:
    """They are what makes `-P` and the bond with the parent; whoever names an interpreter goes past them."""
    found = []
    for name, tree in sources():
        for node in ast.walk(tree):
            command = node.elts[:1] if isinstance(node, ast.List) else [node]
            text = "".join(
                ast.unparse(one) for one in command if isinstance(one, ast.Attribute | ast.Constant)
            )
            if isinstance(node, ast.Constant):  # not the first word of a command
                continue
            if text in STARTERS and name not in STARTING and NAMING.get(name) != text:
                found.append(f"{name}: {text}")
    assert found == []


def test_scripts_of_the_shell_keep_the_working_directory_out() -> None:
    for name in ("scripts/slurm/job.sh", "scripts/slurm/ray.sh"):  # shards.sh calls job.sh
        assert "\nexport PYTHONSAFEPATH=1" in (ROOT / name).read_text(), name
    assert "ENV PYTHONSAFEPATH=1" in (ROOT / "containers/Dockerfile").read_text()
    assert "export PYTHONSAFEPATH=1" in (ROOT / "containers/apptainer.def").read_text()


def test_every_documented_start_by_accelerate_keeps_the_working_directory_out() -> None:
    for page in (ROOT / "docs").rglob("*.md"):
        for before in page.read_text().split("accelerate launch -")[:-1]:
            assert before.endswith("PYTHONSAFEPATH=1 "), page


def searched(command: list[str], folder: Path, **environment: str) -> set[str]:
    """Return the folders that a Python searches for modules."""
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, check=True
    )
    return {os.path.abspath(folder / line) for line in done.stdout.splitlines()}


PRINT_PATH = ("-c", "import sys; print(*sys.path, sep=chr(10))")


def test_a_python_that_we_start_does_not_search_the_working_directory(tmp_path: Path) -> None:
    assert str(tmp_path) in searched([sys.executable, *PRINT_PATH], tmp_path, PYTHONSAFEPATH="")
    assert str(tmp_path) not in searched(python_command(*PRINT_PATH), tmp_path, PYTHONSAFEPATH="")


LEAVE = """
import sys
from vla_eval.workers.children import leave_working_directory
leave_working_directory()
import subprocess
print(*sys.path, sep=chr(10))
subprocess.run([sys.executable, "-c", "import sys; print(*sys.path, sep=chr(10))"], check=True)
"""


@pytest.mark.parametrize(
    ("search_path", "is_searched"),
    [
        (f"{ROOT}", False),
        (f"{ROOT}:", False),
        (f":{ROOT}", False),
        (f"{ROOT}::{ROOT}", False),
        (f":{ROOT}:.", True),
        (f".:{ROOT}", True),
        (f"{ROOT}:{{here}}", True),
        (f":{ROOT}:{{here}}:", True),
    ],
)
def test_the_working_directory_is_searched_only_if_pythonpath_names_it(
    search_path: str, is_searched: bool, tmp_path: Path
) -> None:
    folder, script = tmp_path / "here", tmp_path / "start.py"
    folder.mkdir()
    script.write_text(LEAVE)
    found = searched(
        [sys.executable, str(script)],
        folder,
        PYTHONPATH=search_path.replace("{here}", str(folder)),
        PYTHONSAFEPATH="",
    )
    assert (str(folder) in found) == is_searched


def test_python_m_in_a_checkout_finds_this_package_in_children_too(tmp_path: Path) -> None:
    """`-S`: an installation that points to the checkout does not count."""
    command = [sys.executable, "-S", "-m", "vla_eval.cli", *shlex.split(EVAL), "--out", str(tmp_path / "run")]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": sysconfig.get_path("purelib")}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_bound_command_ends_as_its_program_does() -> None:
    done = subprocess.run(
        bound_command("/bin/sh", "-c", "echo $1; exit 7", "sh", "a b"), capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (7, "a b\n")


def test_a_child_imports_what_it_runs_only_when_it_is_bound_to_its_parent(tmp_path: Path) -> None:
    """Imports take seconds, in which the parent may be killed."""
    process = child_context().Process(target=print)
    rebuild, arguments, state = process.__reduce__()
    assert rebuild.__module__ == "vla_eval.workers.start"
    assert arguments == (os.getpid(),)
    assert state["_target"] is print  # unpickled after the call of `rebuild`
