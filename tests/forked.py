"""Scripts in a process of their own that need not import torch, ManiSkill and lerobot, which takes 10 s."""

import os
import subprocess
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from vla_eval.workers.start import worker_context, worker_environment

# What the script starts in turn is forked from the same process, as if the script had started it.
SCRIPT = """
import os, signal, sys
from multiprocessing import forkserver
os.setsid()
signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ.clear()
os.environ.update({environment!r})
os.chdir({folder!r})
for number, file in ((1, {out!r}), (2, {err!r})):
    os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
forkserver.ensure_running = forkserver._forkserver.ensure_running = lambda: None
exec(compile({script!r}, "script", "exec"), {{"__name__": "__main__"}})
"""


class Forked:
    """A script that runs: its output is in `folder`, in the files `stdout` and `stderr`."""

    def __init__(self, script: str, folder: Path) -> None:
        self.out, self.err = folder / "stdout", folder / "stderr"
        text = SCRIPT.format(
            environment=dict(os.environ),
            folder=str(folder),
            out=str(self.out),
            err=str(self.err),
            script=script,
        )
        with worker_environment():  # the process that is forked may have to start first
            self.process: BaseProcess = worker_context().Process(target=exec, args=(text,))
            self.process.start()

    @property
    def pid(self) -> int:
        """Also the number of its process group, as of a command that a shell starts."""
        assert self.process.pid is not None
        return self.process.pid

    def wait(self, timeout: float | None = None) -> "subprocess.CompletedProcess[str]":
        """Return its exit code and what it wrote; ends it after `timeout` seconds."""
        self.process.join(timeout)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(f"it runs after {timeout} s; it has written: {self.err.read_text('utf-8')}")
        written = (file.read_text("utf-8") for file in (self.out, self.err))
        return subprocess.CompletedProcess("script", self.process.exitcode, *written)


def run_forked(script: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    """Run Python's source in a folder, in a fork of the process that workers are forked from."""
    return Forked(script, folder).wait()


def start_command(arguments: Sequence[str], folder: Path) -> Forked:
    """Start `mikasa-vla` with these arguments in a folder, in a fork of the process above."""
    command = ["mikasa-vla", *arguments]
    script = f"import sys; sys.argv = {command}; from vla_eval.cli.main import main; raise SystemExit(main())"
    return Forked(script, folder)
