"""How workers begin: what they know of the parent's environment, and what becomes of them without it."""

import gc
import importlib.metadata
import os
import signal
import socket
import subprocess
import sys
import time
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import is_alive, wait_until
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import slow_modules
from vla_eval.workers import start as worker_start
from vla_eval.workers.server import IMPORTS_VARIABLE, import_for_workers
from vla_eval.workers.start import begin, worker_context, worker_environment

PARENT = """
import os, sys, time
from vla_eval.workers.start import begin, worker_context, worker_environment
code = "from pathlib import Path; import os, time, vla_eval.workers.inside as inside;"
code += "inside.detach(Path(os.devnull)); there.send(os.getpid()); time.sleep(600)"
context = worker_context()
here, there = context.Pipe()
their_lifeline, lifeline = context.Pipe(duplex=False)
with worker_environment() as environment:
    context.Process(target=begin, args=(environment, their_lifeline, exec, code, {"there": there})).start()
print(here.recv(), flush=True)
time.sleep(600)
"""


def ask(*names: str) -> Any:
    """Return variables of the environment that a new worker sees."""
    return in_a_worker("{name: os.environ.get(name) for name in names}", names=names)


def in_a_worker(expression: str, **given: object) -> Any:
    """Return the value of an expression in a new worker."""
    context = worker_context()
    here, there = context.Pipe()
    their_lifeline, lifeline = context.Pipe(duplex=False)
    code = f"import gc, os; there.send({expression})"
    with worker_environment() as environment:
        process = context.Process(
            target=begin, args=(environment, their_lifeline, exec, code, {"there": there, **given})
        )
        process.start()
    there.close()
    found = here.recv()
    process.join()
    lifeline.close()
    return found


def test_a_worker_has_the_environment_of_its_own_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """And not the one in which an earlier pool of the same process started the server."""
    monkeypatch.setenv("MIKASA_A_TEST", "first")
    assert ask("MIKASA_A_TEST", "OMP_NUM_THREADS")["MIKASA_A_TEST"] == "first"
    monkeypatch.setenv("MIKASA_A_TEST", "second")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert ask("MIKASA_A_TEST", "OMP_NUM_THREADS") == {"MIKASA_A_TEST": "second", "OMP_NUM_THREADS": "1"}
    assert "OMP_NUM_THREADS" not in os.environ


def test_a_worker_collects_its_own_garbage_and_nothing_that_was_imported_before_the_fork() -> None:
    is_enabled, n_left_out = in_a_worker("(gc.isenabled(), gc.get_freeze_count())")
    assert is_enabled
    assert n_left_out > 0


def test_imports_for_workers_look_once_for_what_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asking = "import importlib.metadata\nfound = importlib.metadata.packages_distributions()\n"
    for name in ("asks_first", "asks_again"):
        (tmp_path / f"{name}.py").write_text(asking)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(IMPORTS_VARIABLE, "asks_first:there_is_no_such_module:asks_again")
    original = importlib.metadata.packages_distributions
    try:
        import_for_workers()
    finally:
        gc.unfreeze()
    first, again = (sys.modules.pop(name) for name in ("asks_first", "asks_again"))
    assert first.found is again.found
    assert "numpy" in first.found
    assert importlib.metadata.packages_distributions is original


def test_where_there_is_an_nvidia_driver_nothing_is_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CUDA context does not survive it."""
    monkeypatch.setattr(worker_start, "nvidia_driver_version", lambda: "580.65.06")
    assert worker_context().get_start_method() == "spawn"
    monkeypatch.setattr(worker_start, "nvidia_driver_version", lambda: None)
    assert worker_context().get_start_method() == "forkserver"


def test_only_what_takes_long_is_imported_before_the_fork() -> None:
    tasks = (
        "RememberColor3-v0",
        "RememberColor5-v0",
        "mikasa_base/T-Maze-v0",
        "mikasa_vla/TakeItBack-VLA-v0",
    )
    assert slow_modules([EnvSettings(task=tasks[0], simulator="fake")]) == ()
    assert slow_modules(EnvSettings(task=task) for task in tasks) == (
        "vla_eval.envs.maniskill",
        "vla_eval.envs.mikasa_base",
        "vla_eval.envs.official",
    )


PREPARING = """
import os, sys, time
from multiprocessing import forkserver
from vla_eval.workers.local import LOCAL
LOCAL.prepare(("imported_for_workers",))
print(os.getpid(), forkserver._forkserver._forkserver_pid, flush=True)
time.sleep(float(sys.argv[1]))
"""


@pytest.mark.parametrize("kills", [False, True])
def test_what_was_prepared_imports_before_there_is_a_worker_and_ends_with_the_command(
    tmp_path: Path, kills: bool
) -> None:
    note = tmp_path / "imported"
    module = tmp_path / "imported_for_workers.py"
    module.write_text(f"import time, pathlib; pathlib.Path({str(note)!r}).touch(); time.sleep(600)")
    command = [sys.executable, "-c", PREPARING, "600" if kills else "0"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as parent:
        assert parent.stdout is not None
        command_pid, server = map(int, parent.stdout.readline().split())
        assert parent.pid == command_pid
        if kills:
            wait_until(note.exists)
            assert is_alive(server)
            parent.send_signal(signal.SIGKILL)
    wait_until(lambda: not is_alive(server))


@pytest.mark.parametrize("n_killed", [1, 5])
def test_processes_that_are_killed_while_they_ask_for_a_worker_end_nothing(n_killed: int) -> None:
    """Between connecting and sending, a few microseconds. multiprocessing's own server would end."""
    with worker_environment():
        before = worker_context().Process(target=time.sleep, args=(600,))
        before.start()
    address = forkserver._forkserver._forkserver_address  # type: ignore[attr-defined]
    for _ in range(n_killed):
        with socket.socket(socket.AF_UNIX) as killed:
            killed.connect(address)
    after = worker_context().Process(target=os._exit, args=(7,))
    after.start()
    after.join(30)
    assert after.exitcode == 7
    assert before.is_alive()
    before.kill()


def test_a_worker_ends_with_a_command_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        assert is_alive(worker)
        parent.send_signal(signal.SIGKILL)
    wait_until(lambda: not is_alive(worker))


def test_a_guard_sleeps_while_its_worker_works() -> None:
    context = worker_context()
    here, there = context.Pipe()
    their_lifeline, lifeline = context.Pipe(duplex=False)
    code = "import os, time; there.send(os.getppid()); time.sleep(600)"
    with worker_environment() as environment:
        process = context.Process(
            target=begin, args=(environment, their_lifeline, exec, code, {"there": there})
        )
        process.start()
    guard = here.recv()

    def cpu_ticks() -> int:
        fields = Path(f"/proc/{guard}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])  # of 0.01 s, user and system

    before = cpu_ticks()
    time.sleep(1.0)
    assert guard == process.pid
    assert cpu_ticks() - before <= 2
    lifeline.close()
    process.join(60)
    assert process.exitcode == 0


def test_a_script_without_a_main_guard_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"""from pathlib import Path
Path({str(tmp_path / "runs")!r}).open("a").write("x")
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.evaluate import evaluate
from vla_eval.evaluation.resolve import resolve
config = EvalConfig(
    name="x", tasks=("RememberColor3-v0",), policies=("hold",), episodes=2, workers=2, simulator="fake"
)
print(evaluate(resolve(config, out=Path({str(tmp_path / "out")!r}))).n_open)
"""
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "0\n", "")
    assert (tmp_path / "runs").read_text() == "x"
