"""What planning asks of a policy's servers: what they are. Nobody is waited for."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple  # Any: what a recipe holds

from vla_eval.config.files import Recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import RecipeError, RemoteChangedError
from vla_eval.policies.remote.settings import ADAPTER, RemoteSettings, remote_settings, settings_digest
from vla_eval.wire.addresses import address_name, split_urls
from vla_eval.wire.metadata import ServerMetadata

UNNAMED = "remote"
MAX_SERVER_NAME = 80  # characters of a server's name that records repeat


class SurveyedPolicy(NamedTuple):
    """A policy at an address, and the metadata of its servers."""

    recipe: Recipe[PolicyRecipe]
    server: ServerMetadata


def survey(args: Mapping[str, Any], *, policy: str) -> ServerMetadata:
    """Return what the servers of a policy report, which has to be the same; `args` are the recipe's."""
    return _survey(remote_settings(args, where=f"policy '{policy}'"))


def survey_address(urls: str) -> SurveyedPolicy:
    """Return a recipe for the policy at an address: everything is as the server says, which is asked once."""
    settings = remote_settings({"url": urls}, where=f"policy '{urls:.200}'")
    metadata = _survey(settings)
    # What the server calls itself becomes a part of files' names.
    own_name = re.sub(r"[^A-Za-z0-9._-]", "-", metadata.name or UNNAMED)[:MAX_SERVER_NAME].lstrip(".-")
    recipe = Recipe(
        name=f"{own_name or UNNAMED}@{address_name(split_urls(urls)[0])}",
        path=Path(urls),
        sha256=metadata.recipe_sha256 or settings_digest(settings),
        value=PolicyRecipe(
            version=1,
            description=f"The policy at {urls}.",
            adapter=ADAPTER,
            args={"url": urls},
            default_n_action_steps=metadata.n_action_steps or 1,
        ),
    )
    return SurveyedPolicy(recipe, metadata)


def moved(recipe: Recipe[PolicyRecipe], urls: str) -> PolicyRecipe:
    """Return what a recipe of a policy behind a socket says, for a server at another address."""
    if recipe.value.adapter != ADAPTER:
        raise RecipeError(
            f"{recipe.name}@{urls:.200}: expected a recipe with the adapter '{ADAPTER}', found the adapter "
            f"'{recipe.value.adapter}' in {recipe.path}. For a server of this policy, name the address "
            f"alone: {urls:.200}"
        )
    return replace(recipe.value, args={**recipe.value.args, "url": urls}, finetune=None)


def _survey(settings: RemoteSettings) -> ServerMetadata:
    # Here and not above: most evaluations have no server, and the client takes long to import.
    from vla_eval.policies.remote.connecting import connect_all

    connected = connect_all(split_urls(settings.url), settings, connect_seconds=0.0)
    for one in connected:
        one.client.close()
    first, *others = connected
    for other in others:
        if other.client.metadata.identity() != first.client.metadata.identity():
            raise RemoteChangedError(
                f"{other.url}: expected the policy of {first.url}, found another one: other weights, "
                f"settings or versions. Several servers of one evaluation have to be of the same policy."
            )
    return first.client.metadata
