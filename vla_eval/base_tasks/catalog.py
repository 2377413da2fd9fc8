"""All levels of MIKASA-Base, one row each. Importing it imports none of the environments.

Names are the official package's, CognitiveAISystems/MIKASA-Base at ac81b6f. Memory types and tiers: the
paper, table of memory tasks and section "MIKASA-Base". Figures: `Figures.source` says how they were found.
"""

from vla_eval.base_tasks.catalogs.image_catalog import image_rows
from vla_eval.base_tasks.catalogs.popgym_catalog import popgym_rows
from vla_eval.base_tasks.catalogs.vector_catalog import vector_rows
from vla_eval.base_tasks.row import NAMESPACE, BaseTask
from vla_eval.errors import unknown_name

BASE_TASKS: dict[str, BaseTask] = {
    row.name: row for rows in (vector_rows(), popgym_rows(), image_rows()) for row in rows
}
"""Name -> row."""


def base_task(name: str) -> BaseTask:
    """Return the row of a task, named with or without `mikasa_base/`.

    Raises:
        UnknownNameError: there is none; the message suggests the closest one.
    """
    row = BASE_TASKS.get(name.removeprefix(NAMESPACE))
    if row is None:
        raise unknown_name("task of MIKASA-Base", name.removeprefix(NAMESPACE), BASE_TASKS)
    return row
