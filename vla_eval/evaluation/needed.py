"""What the machines of a cluster must have before an evaluation begins: checkpoints, by path and digest.

Recipes, prompts and settings travel with the episodes; weights do not.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path

from vla_eval.config.evaluation import EvalConfig
from vla_eval.policies.checkpoint import checkpoint_sha256
from vla_eval.policies.checkpoint_notes import LEROBOT_CHECKPOINTS
from vla_eval.policies.run_seeds import load_policy_entry
from vla_eval.wire.addresses import named_server
from vla_eval.workers.needed import Needed

CHECKPOINT_ARGS = ("checkpoint", "base_checkpoint")


def needed_files(config: EvalConfig) -> tuple[Needed, ...]:
    """Return the checkpoints that the policies of an evaluation load.

    Raises:
        UnknownNameError, RecipeError: a policy's recipe cannot be read.
        CheckpointError: a checkpoint is not here.
    """
    return tuple(dict.fromkeys(_checkpoints(config)))


def _checkpoints(config: EvalConfig) -> Iterator[Needed]:
    for name in config.policies:
        if named_server(name) is not None:
            continue
        recipes = [recipe.value for recipe in load_policy_entry(name).recipes]
        own = [recipe for recipe in recipes if recipe.adapter in LEROBOT_CHECKPOINTS]
        for recipe, arg in product(own, CHECKPOINT_ARGS):
            path = recipe.args.get(arg)
            if isinstance(path, str):
                yield Needed(path=path, sha256=checkpoint_sha256(Path(path)), digest=checkpoint_sha256)
