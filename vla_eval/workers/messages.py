"""Messages of a worker other than its answers: failed, found out something. Does not know what a job is."""

import sysconfig
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vla_eval import errors
from vla_eval.core import Stage
from vla_eval.errors import VlaEvalError
from vla_eval.records import EpisodeError

INSTALLED = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
"""The folders of Python's own modules and of installed packages: what lies there is not the user's."""
_NOT_THE_USERS = (str(Path(errors.__file__).parent), *INSTALLED, "<")  # "<": what is not in a file
MAX_DETAILS = 20_000  # characters of a traceback or a message; the log has it all
MAX_KIND = 200  # characters of an exception's class


@dataclass(frozen=True, slots=True, kw_only=True)
class Failed:
    """An episode, or one of a batch, could not be run."""

    error: EpisodeError
    # environment and policy cannot be made or do not fit, for a reason that this package knows: it will
    # be the same for every episode of the group
    refused: bool


class Notice:
    """What a worker has found out; it comes before the answer of the job, and answers none."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceFound(Notice):
    """The device that the environment runs on."""

    device: Mapping[str, str]


def describe_error(exc: BaseException, stage: Stage) -> EpisodeError:
    """Return what is recorded of an exception."""
    try:
        message = str(exc)
    except Exception as in_turn:  # a policy's exception may itself raise when it is printed
        message = f"its message cannot be read ({type(in_turn).__name__})"
    if len(message) > MAX_DETAILS:
        message = f"{message[:MAX_DETAILS]} … ({len(message) - MAX_DETAILS:,} characters left out)"
    return EpisodeError(
        kind=type(exc).__name__[:MAX_KIND],
        stage=stage,
        message=message or f"{type(exc).__name__[:MAX_KIND]} without a message",
        details="".join(traceback.format_exception(exc))[-MAX_DETAILS:],
    )


def own_line(exc: BaseException) -> str | None:
    """Return file and line where the user's own code was when it was raised; None if it was not there."""
    frames = reversed(traceback.extract_tb(exc.__traceback__))
    own = next((frame for frame in frames if not frame.filename.startswith(_NOT_THE_USERS)), None)
    return None if own is None else f"{Path(own.filename).name}, line {own.lineno}"


def as_exception(error: EpisodeError) -> VlaEvalError:
    """Return the worker's exception again; a class of another package becomes its nearest one of ours."""
    found = getattr(errors, error.kind, VlaEvalError)
    is_ours = isinstance(found, type) and issubclass(found, VlaEvalError)
    return found(error.message) if is_ours else VlaEvalError(error.message)
