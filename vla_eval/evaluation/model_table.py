"""A table of learned policies (`docs/paper_table.md`): its fine-tunings, evaluations and folders."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from vla_eval.checkpoints.notes import LEROBOT_ADAPTER
from vla_eval.config.environment import RenderSettings, Simulator
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import check_run_name, recipe_fields
from vla_eval.config.finetuning import FinetuneConfig, merge_fields
from vla_eval.config.policy import load_policy
from vla_eval.errors import RecipeError, check_names
from vla_eval.storage.durable import replace_file
from vla_eval.strict.bounds import (
    MAX_EPISODES,
    MAX_SLOTS,
    MAX_STEPS,
    MAX_TRAINING_STEPS,
    check_bounds,
    check_seeds,
)
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.configured import read_configured

Trained = Literal["all", "adapters", "heads"]

FLOPS_PER_WEIGHT_AND_TOKEN: dict[Trained, int] = {"all": 6, "adapters": 4, "heads": 2}
"""Forward pass 2, gradients of activations 2, gradients of weights 2; attention not counted.

Source: Kaplan et al. 2020, "Scaling laws for neural language models", section 2.1. Adapters need the first
two, heads on frozen features the first.
"""
EVALUATION_FOLDER = "evaluation"  # of the run folders, in the folder of a table
SUSTAINED_TFLOPS = 100
"""What a data-centre GPU is assumed to keep up in bfloat16; an assumption, not a measurement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """What determines the operations of a training step."""

    parameters: float  # weights that each sample goes through
    tokens: int  # of a sample
    trained: Trained  # which of the weights are

    def __post_init__(self) -> None:
        for name in ("parameters", "tokens"):
            if getattr(self, name) < 1:
                raise RecipeError(f"cost: {name} is {getattr(self, name)}, expected ≥ 1.")


@dataclass(frozen=True, slots=True, kw_only=True)
class TableRow:
    """One row: a policy at one or more numbers of action steps."""

    name: str
    # recipe in `policies/` with a `finetune` section, whose chunk has at least `n_action_steps`
    policy: str
    # actions executed per inference; each checkpoint is evaluated at all of them
    n_action_steps: tuple[int, ...]
    tasks: tuple[str, ...] | None = None  # those of the table's tasks that the row is for; None: all
    # fields of the recipe's `finetune` section that are set to other values in this row
    finetune: dict[str, Any] | None = None  # Any: decoded with the row's recipe
    # episodes that a worker evaluates side by side, one forward pass for all of them
    slots_per_worker: int = 1
    # what a training step costs, for the estimate of GPU hours; None where it is small
    cost: StepCost | None = None

    def __post_init__(self) -> None:
        check_run_name(self.name)
        steps = self.n_action_steps
        if not steps or len(set(steps)) != len(steps) or min(steps) < 1:
            raise RecipeError(
                f"row {self.name}: n_action_steps is {list(steps)}, expected numbers ≥ 1, none of them twice."
            )
        bounds = {"n_action_steps": (1, MAX_STEPS), "slots_per_worker": (1, MAX_SLOTS)}
        check_bounds(self, bounds, prefix=f"row {self.name}: ")


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelTable:
    """`configs/*.yaml` with `rows`: a table of learned policies. `docs/paper_table.md` explains it."""

    name: str
    # task ids; each row is fine-tuned for each of them, but for rows that name their own
    tasks: tuple[str, ...]
    datasets: str  # folder with one dataset per task, named like the task
    rows: tuple[TableRow, ...]
    # gradient steps of each fine-tuning; None: as many as each row's recipe says
    steps: int | None = None
    description: str = ""
    run_seeds: tuple[int, ...] = (0,)  # one fine-tuning each; the SEM is over them
    # `episodes`, `seed_start`, `simulator`, `render`, `stop_at_success`: see `EvalConfig`
    episodes: int = 100
    seed_start: int = 1
    # scripted policies next to the rows of a task, at each of their numbers of action steps
    controls: tuple[str, ...] = ("random", "cue_blind", "oracle")
    # the published protocol whose summary figure is printed below the table; None: none
    protocol: str | None = None
    simulator: Simulator = "maniskill"
    # arguments of all tasks, such as the control mode of the datasets
    env: dict[str, Any] = field(default_factory=dict)  # Any: the tasks check their arguments
    render: RenderSettings = field(default_factory=RenderSettings)
    stop_at_success: bool = False
    # fields of the recipes' `finetune` sections that are set to other values in all rows
    finetune: dict[str, Any] | None = None  # Any: decoded with each row's recipe
    allow_unreplayed: bool = False  # see `FinetuneConfig`

    def __post_init__(self) -> None:
        check_run_name(self.name)
        check_bounds(self, {"steps": (1, MAX_TRAINING_STEPS), "episodes": (1, MAX_EPISODES)})
        check_seeds(self.seed_start, self.episodes)
        for run_seed in self.run_seeds:
            check_seeds(run_seed, name="run_seeds")
        for name, values in (
            ("tasks", self.tasks),
            ("rows", [row.name for row in self.rows]),
            ("run_seeds", self.run_seeds),
        ):
            if not values or len(set(values)) != len(values):
                raise RecipeError(f"{name} is {list(values)}, expected at least one, none of them twice.")
        if set(self.controls) & {row.name for row in self.rows}:
            raise RecipeError("rows and controls share a name; records distinguish them by it.")
        for task in self.tasks:
            task_spec(task)
        for row in self.rows:
            check_names("task", row.tasks or (), self.tasks, where=f"row {row.name}")

    def rows_of(self, task: str) -> tuple[TableRow, ...]:
        """Return the rows that a task has."""
        return tuple(row for row in self.rows if row.tasks is None or task in row.tasks)


def narrow(table: ModelTable, *, tasks: Collection[str] = (), rows: Collection[str] = ()) -> ModelTable:
    """Return the part of a table that has these tasks and rows (none: all), in its order and folders."""
    check_names("task", tasks, table.tasks, where=table.name)
    check_names("row", rows, [row.name for row in table.rows], where=table.name)
    chosen = tuple(task for task in table.tasks if not tasks or task in tasks)
    kept = []
    for row in table.rows:
        own = tuple(task for task in chosen if row in table.rows_of(task))
        if own and (not rows or row.name in rows):
            kept.append(replace(row, tasks=None if row.tasks is None else own))
    if not kept:
        named = f"none of the rows {', '.join(rows)}" if rows else "no row"
        raise RecipeError(f"{table.name}: {named} is for {', '.join(tasks)}.")
    return replace(table, tasks=chosen, rows=tuple(kept))


class Finetuning(NamedTuple):
    """One fine-tuning of a table."""

    row: TableRow
    task: str
    run_seed: int
    config: FinetuneConfig

    @property
    def name(self) -> str:
        """For a person."""
        return f"{self.row.name} on {self.task}, run seed {self.run_seed}"


def is_model_table(name: str) -> bool:
    """Whether a configuration is a table of learned policies; errors are those of `recipe_fields`."""
    return "rows" in recipe_fields("configs", name)


def load_model_table(name: str) -> ModelTable:
    """Read a table; errors are those of `load_recipe`."""
    return read_configured(ModelTable, name, folder="configs")


def finetunings(table: ModelTable, out: Path) -> tuple[Finetuning, ...]:
    """Return every fine-tuning of a table, in a fixed order: rows, then tasks, then run seeds."""
    return tuple(
        Finetuning(
            row=row,
            task=task,
            run_seed=run_seed,
            config=FinetuneConfig(
                policy=row.policy,
                dataset=str(Path(table.datasets) / task),
                out=str(_training_folder(out, row, task, run_seed)),
                run_seed=run_seed,
                finetune=merge_fields(
                    {**({} if table.steps is None else {"steps": table.steps}), **(table.finetune or {})},
                    row.finetune or {},
                ),
                allow_unreplayed=table.allow_unreplayed,
            ),
        )
        for row in table.rows
        for task in table.tasks
        if row in table.rows_of(task)
        for run_seed in table.run_seeds
    )


def _training_folder(out: Path, row: TableRow, task: str, run_seed: int) -> Path:
    return out / "training" / row.name / task / f"run-{run_seed}"


def evaluations(
    table: ModelTable, out: Path, *, adapters: dict[str, str] | None = None
) -> Iterator[tuple[Path, EvalConfig]]:
    """Yield run folder and configuration of every evaluation: task by task, the controls first.

    Each row has run folders of its own, so that a table keeps its results when rows or tasks are added.
    The recipes that name the checkpoints are written to `out`; `adapters` names those that are not lerobot's.
    """
    own = adapters or {}
    folder = out / EVALUATION_FOLDER
    for task in table.tasks:
        rows = table.rows_of(task)
        # Chance and ceiling are those of the same number of action steps.
        for steps in sorted({steps for row in rows for steps in row.n_action_steps}):
            if table.controls:
                name = f"{task}-controls-k{steps}"
                yield folder / name, _evaluation(table, name, task, table.controls, (steps,))
        for row in rows:
            for run_seed in table.run_seeds:
                recipe = _write_recipe(out, row, task, run_seed, own.get(row.name, LEROBOT_ADAPTER))
                name = f"{task}-{row.name}-run-{run_seed}"
                config = _evaluation(
                    table, name, task, [recipe], row.n_action_steps, slots_per_worker=row.slots_per_worker
                )
                yield folder / name, config


def _evaluation(
    table: ModelTable,
    name: str,
    task: str,
    policies: Sequence[str],
    n_action_steps: tuple[int, ...],
    *,
    slots_per_worker: int = 1,
) -> EvalConfig:
    return EvalConfig(
        name=name,
        tasks=(task,),
        policies=tuple(policies),
        n_action_steps=n_action_steps,
        episodes=table.episodes,
        seed_start=table.seed_start,
        protocol=table.protocol,
        simulator=table.simulator,
        env=table.env,
        render=table.render,
        stop_at_success=table.stop_at_success,
        slots_per_worker=slots_per_worker,
    )


def _write_recipe(out: Path, row: TableRow, task: str, run_seed: int, adapter: str) -> str:
    folder = out / "policies" / f"{task}-run-{run_seed}"
    recipe = {
        "version": 1,
        "description": f"{row.policy}, fine-tuned on {task}, run seed {run_seed}.",
        "adapter": adapter,
        "args": {"checkpoint": str(_training_folder(out, row, task, run_seed))},
        "default_n_action_steps": row.n_action_steps[0],
        "max_workers": load_policy(row.policy).value.max_workers,
    }
    path = folder / f"{row.name}.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(path, yaml.safe_dump(recipe, sort_keys=False, allow_unicode=True))
    return str(path)


def gpu_hours(row: TableRow, *, steps: int | None) -> float | None:
    """Return a rough estimate of one fine-tuning's GPU hours, from operations alone; None without a cost."""
    recipe = load_policy(row.policy).value.finetune
    if recipe is None:
        raise RecipeError(f"policies/{row.policy}.yaml has no section `finetune`: there is nothing to train.")
    if row.cost is None:
        return None
    own = row.finetune or {}
    n_steps = int(own.get("steps", steps or recipe.steps))
    n_samples = int(own.get("batch_size", recipe.batch_size))
    of_a_sample = FLOPS_PER_WEIGHT_AND_TOKEN[row.cost.trained] * row.cost.parameters * row.cost.tokens
    operations = of_a_sample * n_samples * n_steps
    return operations / (SUSTAINED_TFLOPS * 1e12) / 3600


def describe_effort(table: ModelTable, *, n_finished: int) -> str:
    """Describe the remaining work, for a person."""
    every = finetunings(table, Path())
    told = (
        f"{table.name}: {len(every)} fine-tunings ({len(table.rows)} rows, {len(table.tasks)} tasks, "
        f"{len(table.run_seeds)} run seeds), {n_finished} of them finished."
    )
    per_row = {row.name: gpu_hours(row, steps=table.steps) for row in table.rows}
    known = {name: hours for name, hours in per_row.items() if hours is not None}
    if not known:
        return told
    total = sum(known.get(one.row.name, 0.0) for one in every)
    each = ", ".join(f"{name} {hours:.2g}" for name, hours in known.items())
    return (
        f"{told} All of them take about {total:.0f} GPU hours at {SUSTAINED_TFLOPS} TFLOP/s (operations "
        f"only, an assumption, not a measurement; each: {each})."
    )
