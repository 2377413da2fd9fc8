"""Decide where policies infer: in each worker, or in servers that all workers share."""

from dataclasses import replace
from typing import Any, Literal  # Any: plain data

from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.policies.recipe import bare_policy, is_folder
from vla_eval.storage.planned import named_checkpoints
from vla_eval.wire.addresses import named_server
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL

INFERENCE_FIELDS = ("inference", "inference_max_batch")


def with_inference(config: EvalConfig, backend: Backend) -> EvalConfig:
    """Return the configuration with the choice that is right for a backend, if it leaves the choice.

    Raises:
        UnknownNameError, RecipeError: see `chosen_inference`.
    """
    return replace(config, inference=chosen_inference(config, backend))


def chosen_inference(config: EvalConfig, backend: Backend = LOCAL) -> Literal["in_process", "shared"]:
    """Return where policies with weights infer.

    Left to the program, it is shared where there is a GPU, more than one worker and such a policy.

    Raises:
        UnknownNameError, RecipeError: a policy's recipe cannot be read.
    """
    if config.inference != "auto":
        return config.inference
    n_workers = backend.n_cores if config.workers == "auto" else config.workers
    pays = n_workers > 1 and bool(backend.n_gpus) and any(_has_weights(name) for name in config.policies)
    return "shared" if pays else "in_process"


def has_weights(recipe: PolicyRecipe) -> bool:
    """Whether a policy's recipe names a checkpoint: only such policies are shared."""
    return isinstance(recipe.args.get("checkpoint"), str)


def inference_fields(config: EvalConfig) -> dict[str, Any]:
    """Return what results depend on; nothing for inference in the workers, as before there was a choice."""
    if chosen_inference(config) == "in_process":
        return {}
    return {"inference": "shared", "inference_max_batch": config.inference_max_batch}


def _has_weights(name: str) -> bool:
    named = named_checkpoints(name)
    if named is not None:
        return any(_has_weights(one) for one in named.checkpoints)
    if named_server(name) is not None:
        return False
    return is_folder(name) or has_weights(load_recipe("policies", bare_policy(name), PolicyRecipe).value)
