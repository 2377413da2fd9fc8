"""The result of a check, and how a risky check runs in another process."""

import json
import signal
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from vla_eval.lock.switch import own_need
from vla_eval.workers.children import python_command

Status = Literal["ok", "warn", "fail"]

PROBE_TIMEOUT_SECONDS = 300.0  # a first import on a cold disk takes a minute
SET_UP = "Run `make setup` in the repository."


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check found."""

    status: Status  # `fail` means that evaluations do not work; `warn`, that something may not
    found: str
    advice: str = ""  # what to do, unless all is well


class ProbeFailure(Exception):
    """A probe ended without an answer; the message is its last output."""


type Probe = Callable[[str], Mapping[str, Any]]  # Any: JSON
"""Name of a function of `doctor.subprocess_checks` -> its answer; raises `ProbeFailure`."""


def run_probe(name: str) -> Mapping[str, Any]:  # Any: JSON
    """Call a function of `doctor.subprocess_checks` in another process; `ProbeFailure` if it fails."""
    command = python_command("-m", "vla_eval.doctor.subprocess_checks", name)
    try:
        with own_need():
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=PROBE_TIMEOUT_SECONDS
            )
    except subprocess.TimeoutExpired:
        raise ProbeFailure(f"no answer within {PROBE_TIMEOUT_SECONDS:.0f} s") from None
    if done.returncode < 0:
        raise ProbeFailure(f"crashed with {signal.Signals(-done.returncode).name}")
    if done.returncode > 0:
        raise ProbeFailure((done.stderr.strip().splitlines() or ["no message"])[-1])
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer
