"""Read a configuration of a file or of fields; the one place that completes its names of tasks."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any  # plain data of YAML, flags or arguments

from vla_eval.config.files import Folder, load_recipe
from vla_eval.strict.decoding import decode
from vla_eval.tasks.catalog import with_version


def _nothing(data: dict[str, Any]) -> None:
    """Neither change nor refuse anything."""


def read_configured[C](
    cls: type[C],
    file: str | None,
    *,
    folder: Folder,
    start: Mapping[str, Any] = MappingProxyType({}),
    edit: Callable[[dict[str, Any]], None] = _nothing,
    check: Callable[[dict[str, Any]], None] = _nothing,
    where: str = "",
) -> C:
    """Return a configuration whose `tasks` and `of_tasks`, if it has them, have their versions.

    Fingerprints and names of folders contain the tasks as they are here.

    `file` is a file, or a name in `folder`; without one there are the fields `start`, and `check` refuses
    what is missing. `edit` puts on top what was asked for: flags, arguments. `where`: who gave the fields,
    for messages. Rows of a table may have `tasks` of their own.
    """

    def complete(data: dict[str, Any]) -> None:
        edit(data)
        rows = data.get("rows")
        for part in (data, *(rows if isinstance(rows, list) else ())):
            if isinstance(part, dict) and isinstance(part.get("tasks"), list):  # decoding refuses the rest
                part["tasks"] = [with_version(one) if isinstance(one, str) else one for one in part["tasks"]]
        if isinstance(own := data.get("of_tasks"), dict):
            data["of_tasks"] = {with_version(k) if isinstance(k, str) else k: v for k, v in own.items()}

    if file is not None:
        return load_recipe(folder, file, cls, edit=complete).value
    data = dict(start)
    complete(data)
    check(data)
    return decode(cls, data, where=where)
