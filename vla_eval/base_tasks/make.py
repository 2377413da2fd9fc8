"""Make a MIKASA-Base environment from its row; says which extra is missing."""

import importlib
import os
from typing import Any, cast

from vla_eval.base_tasks.catalog import base_task
from vla_eval.base_tasks.env import BaseTaskEnv
from vla_eval.errors import MissingDependencyError, TaskArgumentError, check_names

HORIZON = "horizon_steps"


def make_base_task(name: str, *, render_mode: str | None = None, **kwargs: Any) -> BaseTaskEnv:
    """Return the environment of a row.

    Args:
        name: `RepeatFirstEasy-v0`, with or without `mikasa_base/`.
        render_mode: `rgb_array`, or None.
        **kwargs: arguments in place of the row's: another level, and its `horizon_steps`.

    Raises:
        UnknownNameError: there is no such task.
        TaskArgumentError: another level without its horizon, or an argument that it does not take.
        MissingDependencyError: it needs a package that is not installed.
    """
    row = base_task(name)
    if kwargs and HORIZON not in kwargs:
        raise TaskArgumentError(
            f"{row.gym_id}: {', '.join(kwargs)}: another level needs its {HORIZON}, too; this row's is "
            f"{row.horizon_steps}."
        )
    check_names("argument", kwargs, (HORIZON, *row.kwargs), where=row.gym_id)
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
