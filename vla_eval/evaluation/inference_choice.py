"""Decide where policies infer: in each worker, or in servers that all workers share."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal  # Any: plain data

from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.policy import PolicyRecipe
from vla_eval.policies.entries import PolicyEntry, load_policy_entries
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL

INFERENCE_FIELDS = ("inference", "inference_max_batch")


def with_inference(
    config: EvalConfig, policies: Sequence[PolicyEntry], backend: Backend = LOCAL
) -> EvalConfig:
    """Return the configuration with the choice that is right for a backend, if it leaves the choice."""
    return replace(config, inference=chosen_inference(config, backend, policies=policies))


def chosen_inference(
    config: EvalConfig, backend: Backend = LOCAL, *, policies: Sequence[PolicyEntry] | None = None
) -> Literal["in_process", "shared"]:
    """Return where policies with weights infer.

    Left to the program, it is shared where there is a GPU, more than one worker and such a policy.

    Args:
        config: the configuration.
        backend: where the workers run.
        policies: those of the configuration; None: they are read if it depends on them.

    Raises:
        VlaEvalError: a policy has to be read, and cannot be.
    """
    if config.inference != "auto":
        return config.inference
    n_workers = backend.n_cores if config.workers == "auto" else config.workers
    if n_workers < 2 or not backend.n_gpus:
        return "in_process"
    entries = load_policy_entries(config.policies) if policies is None else policies
    recipes = (recipe for entry in entries for recipe in entry.recipes)
    return "shared" if any(has_weights(recipe.value) for recipe in recipes) else "in_process"


def has_weights(recipe: PolicyRecipe) -> bool:
    """Whether a policy's recipe names a checkpoint: only such policies are shared."""
    return isinstance(recipe.args.get("checkpoint"), str)


def inference_fields(config: EvalConfig) -> dict[str, Any]:
    """Return what results depend on; nothing for inference in the workers, as before there was a choice."""
    if chosen_inference(config) == "in_process":
        return {}
    return {"inference": "shared", "inference_max_batch": config.inference_max_batch}
