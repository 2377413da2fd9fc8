"""What can be wrong with a configuration: found before the first episode, with what to do."""

from collections.abc import Iterator, Sequence

from vla_eval.checkpoints.notes import (
    LEROBOT_CHECKPOINTS,
    known_chunk_size,
)
from vla_eval.config.evaluation import EvalConfig
from vla_eval.cue_view import CueViewSettings, no_cue_locator
from vla_eval.errors import RecipeError, SpecMismatchError, TaskArgumentError, some_of
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.policies.entries import PolicyEntry
from vla_eval.specs import EnvSpec
from vla_eval.strict.devices import check_device, refuse_missing_gpu
from vla_eval.tasks.arguments import longest_wait_steps
from vla_eval.tasks.spec import TaskSpec

MEMORYLESS = "memoryless"
"""Adapter of the one control that is for MIKASA-Base alone."""
ONE_BY_ONE = (1,)
"""`n_action_steps` of MIKASA-Base."""


def check_instruction(policy: PolicyEntry, env: EnvSpec) -> None:
    """Refuse a robot's policy for a task without a robot, and the other way round."""
    if not env.is_instructed and (policy.value.adapter in LEROBOT_CHECKPOINTS or policy.server is not None):
        raise SpecMismatchError(
            f"policy '{policy.name}' is asked with an instruction, and {env.task} has none, nor a "
            "robot. Leave this task out for this policy."
        )
    if env.is_instructed and policy.value.adapter == MEMORYLESS:
        raise SpecMismatchError(
            f"policy '{policy.name}' is a control of MIKASA-Base; for {env.task} it has to be trained. Run "
            f"`mikasa-vla finetune --policy {policy.name} --dataset DIR --out RUN`, then `mikasa-vla eval "
            "--policy RUN`."
        )


def check_base(config: EvalConfig, task: TaskSpec) -> None:
    """Refuse chunks for a task of MIKASA-Base, in which no action holds still and each is answered."""
    if task.is_base and (config.n_action_steps or ONE_BY_ONE) != ONE_BY_ONE:
        raise RecipeError(
            f"n_action_steps: {list(config.n_action_steps or ())}: {task.id}: expected 1: a "
            "policy has to see what each action brought. Leave n_action_steps out."
        )
    if task.is_base and config.chunking.delay != 0:
        raise RecipeError(
            f"chunking.delay: {task.id}: no action holds still, so that none can take the place of one "
            "that is late. Leave chunking.delay out."
        )


def check_tasks(tasks: Sequence[TaskSpec], policies: Sequence[PolicyEntry]) -> None:
    """Refuse a policy with checkpoints for single tasks that has none for one, or also one for all."""
    for policy in policies:
        own = [one.task for one in policies if one.name == policy.name]
        missing = [task.id for task in tasks if None not in own and task.id not in own]
        if missing:
            raise RecipeError(
                f"policies: expected a checkpoint of '{policy.name}' for each task, found those for "
                f"{some_of(map(str, own))} and none for {some_of(missing)}. Add "
                f"{policy.name}:{missing[0]}=DIR, or leave the task out."
            )
        if None in own and len(own) > 1:
            raise RecipeError(
                f"policies: '{policy.name}' is named twice, once for all tasks and once for "
                f"{some_of(filter(None, own))}. Give the two different names."
            )


def check_devices(resolved: ResolvedEvaluation) -> None:
    """Refuse a device that does not exist or is not there, for simulator, renderer or policies."""
    config = resolved.config
    recipes = [(one.name, recipe.value) for one in resolved.policies for recipe in one.recipes]
    asked = {
        (where := f"policy '{name}': args.device"): check_device(str(recipe.args["device"]), name=where)
        for name, recipe in recipes
        if recipe.adapter in LEROBOT_CHECKPOINTS and "device" in recipe.args
    }
    if config.simulator != "fake":
        asked |= {"sim_backend": config.sim_backend, "render.backend": config.render.backend}
    refuse_missing_gpu(resolved.backend.n_gpus, asked)


def check_changes(config: EvalConfig, task: TaskSpec, env: EnvSpec) -> None:
    """Refuse changes of what a policy sees or remembers that cannot be made in this task."""
    view, reset_step = config.cue_view, config.reset_policy_at_step
    has_phases = task.is_official or longest_wait_steps(task, config.env) > 0
    if view != "as_shown" and not has_phases:
        raise TaskArgumentError(
            f"cue_view={view}: {task.id}: this task has no cue phase in which something could be hidden or "
            "kept. Leave cue_view out for it."
        )
    if CueViewSettings(kind=view).hides and task.is_official:
        raise no_cue_locator(view, task.id)
    moments = {"reset_policy_at_step": (reset_step, "reset")}
    if (change := config.memory_change) is not None:
        moments["memory_change.at_step"] = (change.at_step, "changed")
        if change.kind == "carry_over" and config.seed_start == 0:
            raise RecipeError(
                "memory_change.kind=carry_over: expected a seed_start of 1 or more, found 0: the memory is "
                "that of the episode with the seed before."
            )
    for name, (step, happens) in moments.items():
        if step is not None and step >= env.horizon_steps:
            raise TaskArgumentError(
                f"{name}={step}: {task.id}: the episode ends after {env.horizon_steps} steps: nothing would "
                f"be {happens}. Use a smaller number, or increase env.horizon_steps."
            )


def check_runs(config: EvalConfig, policies: Sequence[PolicyEntry]) -> None:
    """Refuse a number of runs that a policy of several checkpoints does not have."""
    for policy in policies:
        n_checkpoints = len(policy.recipes)
        if policy.is_by_run and config.runs not in (1, n_checkpoints):
            raise RecipeError(
                f"runs: {config.runs}, but policy '{policy.name}' has {n_checkpoints} checkpoints, one per "
                f"run. Expected {n_checkpoints}, so that the other policies have as many runs, or 1."
            )


def check_chunks(config: EvalConfig, policies: Sequence[PolicyEntry]) -> None:
    """Refuse a policy without weights, and more action steps than a checkpoint or server predicts at once."""
    for policy in policies:
        for chunk_size in chunk_sizes(policy):
            for n_action_steps in steps_of(config, policy):
                config.chunking.at(n_action_steps).check_chunk_size(chunk_size, policy=policy.name)


def chunk_sizes(policy: PolicyEntry) -> Iterator[int]:
    """Yield how many actions the chunks of a policy's checkpoints or server have, where that is known."""
    for recipe in policy.recipes:
        known = known_chunk_size(recipe.value.adapter, recipe.value.args, recipe=recipe.name)
        chunk_size = known if policy.server is None else policy.server.chunk_size
        if chunk_size is not None:
            yield chunk_size


def steps_of(config: EvalConfig, policy: PolicyEntry, task: TaskSpec | None = None) -> tuple[int, ...]:
    """Return the `n_action_steps` of a policy, on a task if one is named."""
    if task is not None and task.is_base:
        return ONE_BY_ONE
    return config.n_action_steps or (policy.value.default_n_action_steps,)


def refuse_instruction(config: EvalConfig) -> None:
    """Refuse an instruction among the arguments of tasks."""
    if "instruction" in config.env:
        raise RecipeError(
            "env.instruction: a policy's instruction comes from prompt_set. Put the sentence into a file in "
            "./prompts/ and name that file in prompt_set."
        )


def refuse_doubles(kind: str, names: list[str]) -> None:
    """Refuse a name that stands twice."""
    for name in names:
        if names.count(name) > 1:
            raise RecipeError(f"{kind}: '{name}' is named twice; records distinguish them by name alone.")
