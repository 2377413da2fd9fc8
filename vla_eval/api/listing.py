"""`vla_eval.list_tasks` and `list_policies`: the names that `evaluate` takes."""

from vla_eval.config.files import list_recipes
from vla_eval.strict.calls import public
from vla_eval.tasks.catalog import TASKS, installed_tasks


@public
def list_tasks() -> tuple[str, ...]:
    """Return the ids of all tasks that can be run here, as `mikasa-vla list tasks` does."""
    return (*TASKS, *(name for name in installed_tasks() if name not in TASKS))


@public
def list_policies() -> tuple[str, ...]:
    """Return the names of all policies with a recipe, as `mikasa-vla list policies` does."""
    return tuple(list_recipes("policies"))
