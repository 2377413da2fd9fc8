"""`protocols/*.yaml`: what a published figure fixes: tasks, seeds, runs, K. Knows nothing of results."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from vla_eval.config.files import Recipe, check_run_name, load_recipe
from vla_eval.strict.bounds import (
    MAX_EPISODES,
    MAX_STEPS,
    Bounds,
    Episodes,
    check_bounds,
    check_seeds,
    require,
)

FREE_SETTINGS = ("stop_at_success", "eager_rendering", "render.backend")
"""Settings of an evaluation that no protocol fixes: success at any step is the same with and without them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """`protocols/*.yaml`. `docs/protocols.md` has the table of all fields."""

    name: str
    # raised whenever a figure under the protocol would change
    version: Annotated[int, Bounds(1, MAX_EPISODES)]
    description: str
    source: str  # where it is published
    tasks: dict[str, int]  # task id -> version of the task's rules here
    # `episodes`, `seed_start`: the seeds of each task and run
    episodes: Episodes
    seed_start: int
    runs: Episodes | None = None  # independent training runs; None: one or more
    # the values of K that it allows; None: any, and each K is a row
    n_action_steps: Annotated[tuple[int, ...] | None, Bounds(1, MAX_STEPS)] = None
    metric: Literal["success_once"] = "success_once"  # what is counted of an episode
    # name -> tasks: each has a summary figure of its own; none: one figure over all tasks
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    # settings of an evaluation that a policy may choose; all others have their defaults
    free: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_run_name(self.name)
        check_bounds(self)
        check_seeds(self.seed_start, self.episodes)
        require(bool(self.tasks), "tasks", "{}", "at least one task with its version")
        for group, tasks in self.groups.items():
            others = [task for task in tasks if task not in self.tasks]
            require(bool(tasks) and not others, f"groups.{group}", list(tasks), "tasks of the protocol")

    @property
    def title(self) -> str:
        """Name and version, as tables show them."""
        return f"{self.name} v{self.version}"

    @property
    def seeds(self) -> range:
        """The seeds of the episodes of each task and run."""
        return range(self.seed_start, self.seed_start + self.episodes)

    def is_free(self, path: str) -> bool:
        """Whether a policy may choose this setting (`env.control_mode`), or the section that it is in."""
        return any(path == one or path.startswith(f"{one}.") for one in (*self.free, *FREE_SETTINGS))

    def fields_of_evaluation(self) -> dict[str, Any]:  # Any: plain data
        """Return what an evaluation under this protocol sets, as plain data of `EvalConfig`."""
        known: dict[str, Any] = {
            "tasks": list(self.tasks),
            "episodes": self.episodes,
            "seed_start": self.seed_start,
            "runs": self.runs,
            "n_action_steps": None if self.n_action_steps is None else list(self.n_action_steps),
        }
        return {name: value for name, value in known.items() if value is not None}


def load_protocol(name: str) -> Recipe[Protocol]:
    """Read a protocol; errors as `load_recipe`, or `RecipeError` if the file has another name than it."""
    recipe = load_recipe("protocols", name, Protocol)
    require(recipe.value.name == recipe.name, f"{recipe.path}: name", recipe.value.name, f"'{recipe.name}'")
    return recipe


def fill_from_protocol(data: dict[str, Any]) -> None:  # Any: plain data of YAML
    """Set what the data of an evaluation with `protocol` leave out; errors as `load_protocol`."""
    name = data.get("protocol")
    if not isinstance(name, str):  # none, or a wrong type, which `decode` refuses
        return
    for field_name, value in load_protocol(name).value.fields_of_evaluation().items():
        data.setdefault(field_name, value)
