"""Every error a caller can cause, one class per cause, under one root.

A `VlaEvalError` is a user's mistake or a fact about the machine: the command line prints its message
without a traceback and exits with code 1. A message says what was expected, what was found, where,
and what to do next.
"""

import difflib
import re
from collections.abc import Collection, Iterable

_WORD = re.compile(r"\d+(?:x\d+)*|[A-Z]?[a-z]+|.")
"""A number, or a word, within a name."""
MAX_SHOWN = 200  # characters of what the user wrote that a message repeats
MAX_NAMED = 6  # items of a list that a message names


class VlaEvalError(Exception):
    """Root of all errors of this package."""


class UnknownNameError(VlaEvalError):
    """A task, policy, recipe, field or flag was named that does not exist."""


class RecipeError(VlaEvalError):
    """A recipe file (or an override of one) cannot be read, or holds a value that is not allowed."""


class TaskArgumentError(VlaEvalError):
    """A task was given arguments that are impossible, or impossible together."""


class SpecMismatchError(VlaEvalError):
    """A policy needs something that the environment does not provide, or gives it in another form."""


class InvalidActionError(VlaEvalError):
    """A policy returned actions of a wrong shape or type, or with values that are not finite."""


class SimulationError(VlaEvalError):
    """The simulator gave a state or a reward that is not finite."""


class PluginError(VlaEvalError):
    """An installed package declares something for this one that cannot be used."""


class MissingInstructionError(VlaEvalError):
    """A task has no language instruction where one is needed."""


class MissingDependencyError(VlaEvalError):
    """An optional package, a driver or a library of the machine is not there."""


class RenderingError(VlaEvalError):
    """The renderer could not be started or did not give an image."""


class RunFolderError(VlaEvalError):
    """A run folder is in use, damaged, or not a run folder."""


class FolderInUseError(RunFolderError):
    """Another process is writing into the folder."""


class RunChangedError(RunFolderError):
    """A run cannot be continued, because its configuration or its machine has changed."""


class MergeError(RunFolderError):
    """Shards cannot be put together: they overlap, differ, or one is missing."""


class StorageFullError(RunFolderError):
    """A record could not be made durable."""


class ReportError(VlaEvalError):
    """Runs cannot be put into one table as asked."""


class TooManyErrorsError(VlaEvalError):
    """A run was stopped because episode after episode ended in an error."""


class ClusterError(VlaEvalError):
    """There is no cluster at an address, or no machine of it can be used."""


class CheckpointError(VlaEvalError):
    """A checkpoint is incomplete or damaged, or its weights are not those that the policy needs."""


class DatasetError(VlaEvalError):
    """A dataset is damaged, incomplete, or not of a form that is understood."""


class RecordingError(VlaEvalError):
    """Demonstrations could not be recorded: an expert that fails, a worker that dies, states that differ."""


class ViewingError(VlaEvalError):
    """A video or a rerun file could not be written, found or opened."""


class TrainingError(VlaEvalError):
    """A fine-tuning cannot be started, continued, or has gone wrong."""


class RemotePolicyError(VlaEvalError):
    """Root of what goes wrong with a policy behind a socket."""


class RemoteConnectionError(RemotePolicyError):
    """There is no server at the address, it refused, or the connection was lost."""


class RemoteTimeoutError(RemotePolicyError):
    """No reply came in time. The connection is then closed: a late reply would be taken for the next one."""


class RemoteReplyError(RemotePolicyError):
    """A server replied with an error, or with something else than what was asked."""


class RemoteChangedError(RemotePolicyError):
    """A server is not what it was when the run was planned."""


class RobotError(VlaEvalError):
    """Root of what goes wrong with a robot arm: the episode has no result, and nothing moves afterwards."""


class RobotBusError(RobotError):
    """The motors cannot be read or commanded: a cable, the power, a servo."""


class RobotCameraError(RobotError):
    """A camera is gone, or gives the same image again and again."""


class RobotTimingError(RobotError):
    """The arm was without a command for too long: a slow policy, or a machine that stood still."""


class OperatorError(RobotError):
    """The operator stopped the episode, let go of the dead man's key, or does not answer."""


class LockedError(VlaEvalError, PermissionError):
    """Something was refused by the lock of this process, see `vla_eval.lock`."""


class LockedImportError(VlaEvalError, ImportError):
    """A module was refused, since it lies where nothing is installed, see `vla_eval.lock`."""


class ConformanceError(VlaEvalError):
    """An environment, a policy or a task breaks a promise of its contract (`vla_eval.testing`)."""


NOT_SET = 'If a shell variable stands there, it is not set, or empty: `echo "$NAME"` shows it.'
"""What may be wrong where text is empty."""


def some_of(items: Iterable[object]) -> str:
    """Return the first items of a list, with commas, and how many more there are."""
    names = [str(item) for item in items]
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `" Did you mean 'x'?"` for the closest known name, or `""` if none is close.

    Where one number or word of it is wrong, as in `RememberColor4-v0`, all that stand there are named.
    Comparing ignores case.
    """
    by_folded = {candidate.lower(): candidate for candidate in known}
    # Longer names are not typos, and comparing takes time that grows with the square of the length.
    close = difflib.get_close_matches(name[:MAX_SHOWN].lower(), list(by_folded), n=1, cutoff=0.5)
    if not close:
        return ""
    meant = _levels(name, by_folded[close[0]], by_folded.values()) or [by_folded[close[0]]]
    return f" Did you mean '{"' or '".join(meant)}'?"


def _levels(name: str, closest: str, known: Iterable[str]) -> list[str]:
    """Return the names that differ from the closest in its number or word alone that is wrong in this one."""
    words = _WORD.findall(closest)
    for index, word in enumerate(words):
        before, after = "".join(words[:index]), "".join(words[index + 1 :])
        if not re.search(r"\w", before + after):  # any name at all would differ in this word alone
            continue
        family = f"{re.escape(before)}(%s){re.escape(after)}"
        found = re.fullmatch(family % "[a-z]*|[0-9x]*", name, re.IGNORECASE)
        if found and (word[0].isdigit() or not difflib.get_close_matches(found[1], [word])):
            return [one for one in known if re.fullmatch(family % _WORD.pattern, one)][:MAX_NAMED]
    return []


def unknown_name(kind: str, name: str, known: Iterable[str], *, where: str = "") -> UnknownNameError:
    """Build the error for a name that does not exist: what it was, and a suggestion or what exists.

    A long list is given only if no known name is close. `kind`: what is named, in the singular; `where`: the
    field or flag in which it stands.
    """
    names = sorted(known)
    prefix = f"{where}: " if where else ""
    problem = f"{prefix}there is no {kind} '{name:.{MAX_SHOWN}}'."
    suggestion = did_you_mean(name, names)
    if suggestion and len(names) > MAX_NAMED:
        return UnknownNameError(f"{problem}{suggestion} ({len(names)} are known.)")
    return UnknownNameError(f"{problem}{suggestion} Known: {', '.join(names)}.")


def check_names(kind: str, names: Iterable[str], known: Collection[str], *, where: str = "") -> None:
    """Raise `UnknownNameError` for the first name that does not exist; `kind` and `where` as above."""
    for name in names:
        if name not in known:
            raise unknown_name(kind, name, known, where=where)
