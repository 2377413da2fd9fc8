"""Configurations from the arguments of a function: what a verb makes of a file and flags."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any  # plain data, whatever the user gives

from vla_eval.cli.shared.slips import TOLD
from vla_eval.config.files import Folder, to_data
from vla_eval.errors import RecipeError, UnknownNameError, check_names
from vla_eval.tasks.configured import read_configured


def configured[C](
    cls: type[C],
    config: C | str | Path | None,
    given: Mapping[str, Any],
    *,
    folder: Folder,
    start: Mapping[str, Any],
    needed: Mapping[str, str],
    where: str,
    edit: Callable[[dict[str, Any]], None] = lambda _data: None,
) -> C:
    """Return a configuration, its file, or the fields `start`, with what is `given` on top.

    Names are looked up in `folder`. A value of None was not given. `needed` has field -> the argument that
    must give it if there is no configuration; `where` is the function, for messages, and `edit` changes the
    data at the end.
    `RecipeError`: an argument is missing, or a field does not exist or cannot have this value.
    """

    def complete(data: dict[str, Any]) -> None:
        data.update({name: value for name, value in given.items() if value is not None})
        edit(data)

    def check(data: dict[str, Any]) -> None:
        known = [one.name for one in fields(cls)]  # type: ignore[arg-type]
        for name in data:
            if name not in known and (told := TOLD.get(f"--{name}".replace("_", "-"))):
                raise UnknownNameError(f"{where}: there is no field '{name}'. {told}")
        check_names("field", data, known, where=where)
        missing = [argument for field, argument in needed.items() if field not in data]
        if missing:
            raise RecipeError(
                f"{where}: `{missing[0]}` is missing. Expected a configuration, or at least "
                f"{' and '.join(needed.values())}: vla_eval.{where}({EXAMPLES[where]})"
            )

    file = str(config) if isinstance(config, (str, Path)) else None
    fields_of = start if config is None or isinstance(config, (str, Path)) else to_data(config)
    return read_configured(cls, file, folder=folder, start=fields_of, edit=complete, check=check, where=where)


EXAMPLES = {
    "evaluate": 'policy="oracle", tasks="RememberColor3-v0"',
    "run_probe": 'policy="oracle", tasks="RememberColor3-v0"',
    "record": 'tasks="RememberColor3-v0", episodes=10',
    "finetune": 'policy="act", dataset="data/RememberColor3-v0", steps=20000',
}


def listed(value: Any) -> list[Any] | None:
    """Return one or several as a list, numbers of numpy as Python's; None stays."""
    if value is None:
        return None
    if hasattr(value, "tolist"):
        value = value.tolist()
    return list(value) if isinstance(value, (list, tuple, range)) else [value]
