"""Standard output and error for the command line, whatever they are connected to, or if they are closed.

Standard error carries messages: if it cannot be written, the run does not stop. Standard output carries the
result: if it cannot be written, the command reports that and fails. Both print no control characters.
"""

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator
from types import TracebackType
from typing import Any, TextIO, cast

from vla_eval.cli.terminal.screen import folded, message_width
from vla_eval.errors import VlaEvalError
from vla_eval.plain_text import PlainStream

STDOUT_FD, STDERR_FD = 1, 2


class UnwritableOutputError(VlaEvalError):
    """Standard output cannot be written."""


class _Stream(PlainStream):
    """A plain stream of which `write` and `flush` meet an `OSError` in their own way."""

    def _put(self, text: str) -> None:
        try:
            self._stream.write(text)
        except OSError as exc:
            self._meet(exc)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as exc:
            self._meet(exc)

    def _meet(self, exc: OSError) -> None:
        """Drop what cannot be written: there is no other stream to report it on."""


class _Messages(_Stream):
    """Standard error; on a terminal, sentences are folded to its width."""

    def _put(self, text: str) -> None:
        width = message_width(self._stream)
        super()._put(text if width is None or "\r" in text else folded(text, width))


class _Output(_Stream):
    def _meet(self, exc: OSError) -> None:
        if isinstance(exc, BrokenPipeError):  # the reader has seen enough (`| head`)
            raise exc
        raise UnwritableOutputError(
            f"standard output: cannot be written ({exc.strerror or exc}). What was stored is kept; send the "
            f"output somewhere else and run the same command again."
        ) from exc


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Make standard output and error safe to write to; restore them afterwards."""
    # Open what the shell has closed (`2>&-`): else the next file, perhaps of results, takes its number.
    for descriptor in range(STDERR_FD + 1):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest free number is given, which is this one. Standard output is to be unwritable still.
            os.open(os.devnull, os.O_RDONLY if descriptor == STDOUT_FD else os.O_RDWR)
    before = (sys.stdout, sys.stderr)
    # A closed stream is None, and `print(file=None)` would write to the other one.
    out = sys.stdout or os.fdopen(STDOUT_FD, "w", encoding="utf-8", closefd=False)
    error = sys.stderr or os.fdopen(STDERR_FD, "w", encoding="utf-8", closefd=False)
    errors = [_escape(stream) for stream in (out, error)]
    sys.stdout, sys.stderr = cast(TextIO, _Output(out)), cast(TextIO, _Messages(error))
    try:
        yield
    except Exception:
        sys.excepthook = _print_traceback  # which Python calls when the streams are its own again
        raise
    finally:
        sys.stdout, sys.stderr = before
        for stream, previous in zip((out, error), errors, strict=True):
            _leave(stream, previous)


def _print_traceback(kind: type[BaseException], exc: BaseException, trace: TracebackType | None) -> None:
    """Print a traceback as Python does, without the control characters of its message."""
    if sys.stderr is not None:
        PlainStream(sys.stderr).writelines(traceback.format_exception(kind, exc, trace))


def _escape(stream: TextIO) -> str | None:
    r"""Have what the stream's encoding lacks written as `\u2014`; return what was done before."""
    reconfigure = getattr(stream, "reconfigure", None)
    if reconfigure is None:  # a caller's own stream
        return None
    previous = stream.errors
    reconfigure(errors="backslashreplace")
    return previous


def _leave(stream: TextIO, errors: str | None) -> None:
    """Undo `_escape`; what could not be written must not be tried again by Python's own end."""
    try:
        stream.flush()
        if errors is not None:
            cast(Any, stream).reconfigure(errors=errors)  # Any: `TextIO` does not declare it
    except OSError:
        with contextlib.suppress(OSError):  # no descriptor: a caller's own stream
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
