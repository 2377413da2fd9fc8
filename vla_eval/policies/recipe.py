"""A policy by its name: a recipe in `policies/`, a folder or Hub id of a LeRobot checkpoint, or an address.

Knows nothing of models: a folder is looked at, never loaded; a server is asked what it is.
"""

import logging
import os
from dataclasses import replace
from pathlib import Path

from vla_eval.checkpoints.bases import find_base, hub_folder
from vla_eval.checkpoints.config_check import MAX_ACTIONS
from vla_eval.checkpoints.files import (
    CONFIG_FILE,
    checkpoint_name,
    checkpoint_sha256,
    find_checkpoint,
    read_json,
    weights_file,
)
from vla_eval.checkpoints.policy_types import asked_for_steps
from vla_eval.config.files import Recipe, list_recipes, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.models.families import family_of
from vla_eval.policies.remote.survey import moved, survey_address
from vla_eval.strict.json_fields import get_count, get_text
from vla_eval.wire.addresses import named_server

logger = logging.getLogger(__name__)

BIG_CHECKPOINT_BYTES = 1 << 30  # of such policies one worker is enough for a GPU, and too much for most CPUs


def bare_policy(name: str) -> str:
    """Return the recipe of `RECIPE@ws://…`, since the address moves no result; other names as they are."""
    server = named_server(name)
    return name if server is None or server.recipe is None else server.recipe


def load_policy_recipe(name: str) -> Recipe[PolicyRecipe]:
    """Return the recipe of a policy, or one for the checkpoint in a folder or for the server at an address.

    `name` is a recipe's name or file; a folder: a fine-tuning run, a checkpoint in it, or a LeRobot
    checkpoint; `hub:OWNER/NAME@REVISION`, which is fetched if it is not there (the recipe's digest is that of
    the checkpoint's files); or `ws://HOST:PORT`, with commas if there are several, maybe after `RECIPE@`.

    Raises:
        UnknownNameError, RecipeError: see `load_recipe`.
        CheckpointError: it is a folder without a checkpoint, or the Hub does not give it.
        RemotePolicyError: it is an address, and there is no policy server.
    """
    server = named_server(name)
    if server is not None and server.recipe is None:
        return survey_address(server.urls).recipe
    if server is not None:
        recipe = load_recipe("policies", bare_policy(name), PolicyRecipe)
        return replace(recipe, value=moved(recipe, server.urls))
    fetched = hub_folder(name)
    if fetched is not None and not fetched.is_dir():
        # Here and not above: the Hub's client takes long to import.
        from vla_eval.checkpoints.fetching import fetch_base

        fetch_base(find_base(name), fetched, say=logger.warning)
    elif fetched is None and not is_folder(name):
        return load_recipe("policies", name, PolicyRecipe)
    folder = find_checkpoint(Path(name))
    config = read_json(folder / CONFIG_FILE)
    where = str(folder / CONFIG_FILE)
    n_action_steps = get_count(config, "n_action_steps", maximum=MAX_ACTIONS, where=where)
    kind = get_text(config, "type", where=where)
    if asked_for_steps(kind):  # its own queue holds that many
        n_action_steps = None
    weights = weights_file(folder)
    is_big = weights is not None and weights.stat().st_size >= BIG_CHECKPOINT_BYTES
    return Recipe(
        name=checkpoint_name(folder),
        path=folder,
        sha256=checkpoint_sha256(folder),
        value=PolicyRecipe(
            version=1,
            description=f"A checkpoint of type {kind}.",
            adapter=family_of(kind or "").adapter,
            args={"checkpoint": str(folder)},
            default_n_action_steps=n_action_steps or 1,
            max_workers=1 if is_big else None,
        ),
    )


def is_folder(name: str) -> bool:
    """Whether the user means a folder: recipes come first where there is one of that name."""
    # os.path, unlike Path, says no to what cannot be a path at all: too long, or with a NUL.
    return os.path.isdir(name) and name not in list_recipes("policies")
