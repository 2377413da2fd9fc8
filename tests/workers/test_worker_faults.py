"""What policies do to the processes around them: broken pipes, daemons, a fork server that is no more."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import TASK, Bench
from tests.waiting import is_alive, wait_until

bench = evaluation_bench.bench

# Executes what the recipe says for a seed at step 2.
DOING_MODULE = """
import contextlib, os, pickle, signal, socket, stat, struct, subprocess, sys, time
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent

def sockets():
    numbers = [int(name) for name in os.listdir("/proc/self/fd")]
    return [n for n in numbers if os.path.exists(f"/proc/self/fd/{n}") and stat.S_ISSOCK(os.stat(n).st_mode)]

def write(data):
    for number in sockets():
        os.write(number, data)

def write_into_all(data):
    for name in os.listdir("/proc/self/fd"):
        if int(name) > 2:  # standard error goes into the worker's log
            with contextlib.suppress(OSError):  # it is for reading only
                os.write(int(name), data)

def start_daemon():
    code = "import os, sys, time; os.fork() and os._exit(0);"
    code += "open(sys.argv[1] + str(os.getpid()), 'w'); time.sleep(600)"
    subprocess.Popen([sys.executable, "-c", code, str(HERE / "daemon-")], start_new_session=True).wait()
    while not list(HERE.glob("daemon-*")):
        time.sleep(0.01)

class Policy:
    def __init__(self, context, does):
        (HERE / f"pid-{os.getpid()}").touch()
        self.spec = PolicySpec(name="does", reads="last", cameras=(), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.does = does
    def reset(self, episodes):
        self.seed = episodes[0].seed
    def act(self, window):
        if window.last.step == 2:
            exec(self.does.get(str(self.seed), ""), globals())
        return ActionChunk(actions=np.zeros((self.spec.chunk_size, 7), dtype="float32"))

def make(context, *, does):
    return Policy(context, does)
"""

# Stops or kills the process that workers are forked from once the first record is there.
SERVER_SCRIPT = """
import os, sys, time
from multiprocessing import forkserver
from pathlib import Path
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.evaluation.resolve import resolve
from vla_eval.strict.decoding import decode
from vla_eval.config.evaluation import EvalConfig

evaluate_module.collect_environment = lambda: {"machine": "test"}

class Observer(evaluate_module.EvaluationObserver):
    def on_record(self, record):
        if not self.__dict__.setdefault("seen", False):
            self.seen = True
            os.kill(forkserver._forkserver._forkserver_pid, int(sys.argv[1]))

data = {"name": "t", "tasks": ["RememberColor3-v0"], "policies": ["random", "hold"], "episodes": 2,
        "simulator": "fake", "workers": 1, "timeouts": {"setup_seconds": float(sys.argv[3])}}
config = decode(EvalConfig, data, where="t")
summary = evaluate_module.evaluate(resolve(config, out=Path(sys.argv[2])), observer=Observer())
print(summary.n_errors, summary.n_open)
"""


def doing(bench: Bench, **does: str) -> None:
    (bench.folder / "doing_policy.py").write_text(DOING_MODULE)
    bench.write_policy("doing_policy:make", does={name.lstrip("s"): code for name, code in does.items()})


def daemons(bench: Bench) -> list[int]:
    return [int(path.name.removeprefix("daemon-")) for path in bench.folder.glob("daemon-*")]


def test_what_a_policy_writes_into_its_socket_is_an_error_of_that_episode_alone(bench: Bench) -> None:
    doing(
        bench,
        s2="write(b'rubbish')",
        s3="write(struct.pack('>10sQ', b'mikasa-vla', 1 << 60))",
        s4="data = pickle.dumps('an answer'); write(struct.pack('>10sQ', b'mikasa-vla', len(data)) + data)",
        s5="write(struct.pack('>10sQ', b'mikasa-vla', 4) + b'junk')",
        s6="write(bytes(1 << 20)); time.sleep(600)",
        s7="[os.close(number) for number in sockets()]; time.sleep(600)",
        s8="write(struct.pack('>10sQ', b'mikasa-vla', 1000)); time.sleep(600)",
    )
    summary = bench.run("out", episodes=9, workers=2, timeouts={"inference_seconds": 4.0})

    records = bench.records("out")
    kinds = {seed: record.error.kind for seed, record in records.items() if record.error is not None}
    assert kinds == {**dict.fromkeys(range(2, 8), "WorkerCrashed"), 8: "InferenceTimeout"}
    assert summary.n_errors == 7
    messages = {seed: record.error.message for seed, record in records.items() if record.error is not None}
    assert "found b'rubbish" in messages[2]
    assert "1,152,921,504,606,846,976 bytes" in messages[3]
    assert "found one of type str" in messages[4]
    assert "cannot be unpickled" in messages[5]


def test_what_a_policy_writes_into_any_descriptor_ends_no_process_but_its_own(bench: Bench) -> None:
    shared = (
        "from multiprocessing.shared_memory import SharedMemory; block = SharedMemory(create=True, size=1)"
    )
    doing(bench, s1="write_into_all(b'rubbish')", s2=f"{shared}; block.close(); block.unlink()")
    command = [sys.executable, "-m", "vla_eval.cli", "eval", "--task", TASK, "--policy", "night.yaml"]
    command += ["--workers", "1", "--episodes", "3", "--out", "out", "--set", "simulator=fake"]
    done = subprocess.run(command, cwd=bench.folder, capture_output=True, text=True, timeout=240)

    errors = {seed: record.error for seed, record in bench.records("out").items() if record.error is not None}
    assert {seed: error.kind for seed, error in errors.items()} == {1: "WorkerCrashed"}
    assert "Traceback" not in done.stderr


def test_an_exception_of_any_size_is_recorded_in_part(bench: Bench) -> None:
    doing(
        bench,
        s1="raise ValueError('x' * 10_000_000)",
        s2="raise type('Odd', (Exception,), {'__str__': lambda self: 1 / 0})()",
    )
    bench.run("out", episodes=2)

    errors = {seed: record.error for seed, record in bench.records("out").items()}
    assert errors[1] is not None and errors[2] is not None
    assert errors[1].message.startswith("x" * 20_000 + " … (9,980,000 characters left out) (")
    assert errors[2].message.startswith("its message cannot be read (ZeroDivisionError) (")
    assert (bench.folder / "out" / "episodes.jsonl").stat().st_size < 100_000


@pytest.mark.parametrize(
    "then", ["", "os._exit(7)", "time.sleep(600)", "os.kill(os.getpid(), signal.SIGKILL)"]
)
def test_a_daemon_dies_with_the_worker_that_started_it(bench: Bench, then: str) -> None:
    doing(bench, s1=f"start_daemon(); {then}")
    bench.run("out", episodes=1, timeouts={"inference_seconds": 4.0})

    (daemon,) = daemons(bench)
    assert not is_alive(daemon)


def test_a_daemon_dies_with_a_command_that_is_killed(bench: Bench) -> None:
    doing(bench, s1="start_daemon(); time.sleep(600)")
    command = [sys.executable, "-m", "vla_eval.cli", "eval", "--task", TASK, "--policy", "night.yaml"]
    command += ["--workers", "1", "--out", "out", "--set", "simulator=fake"]
    with subprocess.Popen(command, cwd=bench.folder, stderr=subprocess.DEVNULL) as process:
        try:
            wait_until(lambda: bool(daemons(bench)))
        finally:
            process.kill()
    pids = {*bench.worker_pids(), *daemons(bench)}
    assert len(pids) == 2
    wait_until(lambda: not any(is_alive(pid) for pid in pids))


def run_with_server(number: signal.Signals, out: Path, *, setup_seconds: float) -> str:
    script = [sys.executable, "-c", SERVER_SCRIPT, str(int(number)), str(out), str(setup_seconds)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_fork_server_that_is_killed_costs_no_episode(tmp_path: Path) -> None:
    assert run_with_server(signal.SIGKILL, tmp_path / "out", setup_seconds=200) == "0 0"


@pytest.mark.slow
def test_a_fork_server_that_is_stopped_costs_no_episode(tmp_path: Path) -> None:
    assert run_with_server(signal.SIGSTOP, tmp_path / "out", setup_seconds=200) == "0 0"
