"""Make a MIKASA-Base environment from its row; says which extra is missing."""

import importlib
import os
from typing import Any, cast

from vla_eval.base_tasks.catalog import base_task
from vla_eval.base_tasks.env import BaseTaskEnv
from vla_eval.errors import MissingDependencyError


def make_base_task(name: str, *, render_mode: str | None = None, **kwargs: Any) -> BaseTaskEnv:
    """Return the environment of a row.

    Args:
        name: `RepeatFirstEasy-v0`, with or without `mikasa_base/`.
        render_mode: `rgb_array`, or None.
        **kwargs: arguments in place of the row's: another level.

    Raises:
        UnknownNameError: there is no such task.
        MissingDependencyError: it needs a package that is not installed.
    """
    row = base_task(name)
    module, _, attribute = row.entry_point.partition(":")
    # Else pygame greets on standard output, where a table may go.
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        make = getattr(importlib.import_module(module), attribute)
        arguments = {"horizon_steps": row.horizon_steps, **row.kwargs, **kwargs}
        return cast("BaseTaskEnv", make(render_mode=render_mode, **arguments))
    except ModuleNotFoundError as exc:
        if not row.extra or exc.name is None or exc.name.split(".")[0] == "vla_eval":
            raise
        raise MissingDependencyError(
            f"{row.gym_id} needs the package '{exc.name}', which is not installed. In a clone: `make base`; "
            f"elsewhere: pip install 'mikasa-vla-eval[{row.extra}]'. See docs/mikasa_base.md."
        ) from exc
