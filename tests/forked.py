"""Scripts in a process of their own that need not import torch, ManiSkill and lerobot, which takes 10 s."""

import subprocess
from pathlib import Path

from vla_eval.workers.start import worker_context, worker_environment

SCRIPT = """
import os, sys
os.chdir({folder!r})
for number, file in ((1, {out!r}), (2, {err!r})):
    os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
exec(compile({script!r}, "script", "exec"), {{"__name__": "__main__"}})
"""


def run_forked(script: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    """Run Python's source in a folder, in a fork of the process that workers are forked from."""
    out, err = folder / "stdout", folder / "stderr"
    text = SCRIPT.format(folder=str(folder), out=str(out), err=str(err), script=script)
    with worker_environment():  # the process that is forked may have to start first
        process = worker_context().Process(target=exec, args=(text,))
        process.start()
    process.join()
    code = process.exitcode
    assert code is not None
    return subprocess.CompletedProcess(script, code, out.read_text("utf-8"), err.read_text("utf-8"))
