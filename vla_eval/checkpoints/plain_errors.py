"""One message for whatever lerobot, torch and transformers raise of files that do not fit."""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn  # Any: lerobot is untyped

import torch

from vla_eval.errors import CheckpointError, MissingDependencyError, VlaEvalError
from vla_eval.strict.json_fields import FETCH_AGAIN


@contextlib.contextmanager
def plain_errors(where: Path | str, kind: str, what: str) -> Iterator[None]:
    """Raise one `CheckpointError` for whatever lerobot, torch and transformers raise within `what`."""
    try:
        yield
    except VlaEvalError:
        raise
    except Exception as exc:
        is_memory = isinstance(exc, MemoryError | torch.OutOfMemoryError)
        hint = f"Expected processors, a configuration and weights that belong together. {FETCH_AGAIN}"
        raise CheckpointError(
            f"{where}: the policy of type '{kind}' {what}: {type(exc).__name__}: {exc!s:.500} "
            f"{'Use a device with more memory, or smaller batches.' if is_memory else hint}"
        ) from exc


def raise_plainly(exc: ImportError | OSError | RuntimeError, config: Any) -> NoReturn:
    """Say which package or file is missing, if that made `exc`; otherwise raise `exc` again."""
    if isinstance(exc.__cause__, VlaEvalError):
        raise exc.__cause__
    if isinstance(exc, ImportError):
        raise MissingDependencyError(
            f"a LeRobot policy of type '{config.type}' needs a package that is not installed: {exc}"
        ) from exc
    if not says_what_is_missing(exc):
        raise exc
    missing = exc if isinstance(exc, OSError) else exc.__cause__
    on_hub = ", ".join(f"{name} ({value})" for name, value in names_on_hub(config).items())
    of_config = f" Of the Hub, its configuration names {on_hub}." if on_hub else ""
    raise CheckpointError(
        f"a LeRobot policy of type '{config.type}' could not be built without the network: "
        f"{missing}{of_config} Give it a local folder (in that field; `tokenizer`, if that is what is "
        "missing), or set HF_HUB_OFFLINE=0 once to let it fetch the file."
    ) from exc


def names_on_hub(config: Any) -> dict[str, str]:
    """Return the fields of a configuration that name a repository of the Hub, `OWNER/NAME`."""
    return {
        name: value
        for name, value in vars(config).items()
        if name not in ("repo_id", "type")
        and isinstance(value, str)
        and re.fullmatch(r"[\w.-]+/[\w.-]+", value)
        and not Path(value).exists()
    }


def says_what_is_missing(exc: BaseException) -> bool:
    """Whether a file is missing, or one of our errors is the cause: lerobot's π0-FAST wraps both."""
    return isinstance(exc, OSError) or isinstance(exc.__cause__, OSError | VlaEvalError)
