"""The policies of a configuration, each read once: `NAME=A,B,C` or `NAME:TASK=A,B,C` of checkpoints."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.checkpoints.bases import hub_folder
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.config.files import Recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import NOT_SET, RecipeError
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.policies.remote.survey import survey, survey_address
from vla_eval.storage.planned import named_checkpoints, part_of
from vla_eval.tasks.catalog import task_spec
from vla_eval.wire.addresses import named_server
from vla_eval.wire.metadata import ServerMetadata


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyEntry:
    """One entry of a configuration's `policies`."""

    name: str  # what records call it
    recipes: tuple[Recipe[PolicyRecipe], ...]  # one; or one per run, for a policy of several checkpoints
    texts: tuple[str, ...]  # what the configuration calls each of them
    is_by_run: bool = False  # whether each recipe is a run of its own
    task: str | None = None  # the id of the only task that it is for; None: all
    server: ServerMetadata | None = None  # of a policy behind a socket, its server's metadata

    @property
    def value(self) -> PolicyRecipe:
        """What all its recipes agree on: the code, and for which tasks it is."""
        return self.recipes[0].value

    def part(self, index: int) -> str:
        """Return the name of a recipe in `run.json`: those of several checkpoints are numbered."""
        return part_of(self.name, task=self.task, run=index if self.is_by_run else None)


def load_policy_entries(texts: Sequence[str]) -> tuple[PolicyEntry, ...]:
    """Return the policies of a configuration, see `load_policy_entry`."""
    return tuple(load_policy_entry(text) for text in texts)


def load_policy_entry(text: str) -> PolicyEntry:
    """Return the policy that an entry of a configuration names, with all its checkpoints."""
    named = named_checkpoints(text)
    # `NAME=` and `NAME=A,,B`, as of a shell variable that is not set.
    name, equals, folders = text.partition("=")
    if equals and not all(folders.split(",")) and not os.path.exists(text):
        raise RecipeError(
            f"policies: {text}: expected a folder with a checkpoint after '{name}=', found empty text. "
            f"{NOT_SET}"
        )
    if named is None:
        return _single(text)
    for one in named.checkpoints:
        if named_server(one) is not None:
            raise _is_served(text, one)
    recipes = tuple(load_policy_recipe(one) for one in named.checkpoints)
    for one, recipe in zip(named.checkpoints, recipes, strict=True):
        if recipe.value.adapter == REMOTE_ADAPTER:
            raise _is_served(text, one)
    _check_alike(text, named.checkpoints, recipes)
    task = None if named.task is None else task_spec(named.task).id
    return PolicyEntry(name=named.name, recipes=recipes, texts=named.checkpoints, is_by_run=True, task=task)


def refuse_unfetched(texts: Sequence[str]) -> None:
    """Raise `CheckpointError` for a Hub id that is not here yet: reading the policies would fetch it."""
    for text in texts:
        named = named_checkpoints(text)
        for one in (text,) if named is None else named.checkpoints:
            if hub_folder(one) is not None:
                find_checkpoint(Path(one))


def _single(text: str) -> PolicyEntry:
    """Return a policy of one recipe; its server, if it has one, is asked what it is."""
    address = named_server(text)
    if address is not None and address.recipe is None:
        recipe, server = survey_address(address.urls)
        return PolicyEntry(name=recipe.name, recipes=(recipe,), texts=(text,), server=server)
    recipe = load_policy_recipe(text)
    is_remote = recipe.value.adapter == REMOTE_ADAPTER
    said = survey(recipe.value.args, policy=recipe.name) if is_remote else None
    return PolicyEntry(name=recipe.name, recipes=(recipe,), texts=(text,), server=said)


def _is_served(text: str, one: str) -> RecipeError:
    return RecipeError(
        f"policies: {text}: expected folders of checkpoints or names in policies/ with weights, found {one}. "
        f"Give a policy server without a name and '='."
    )


def _check_alike(text: str, names: tuple[str, ...], recipes: tuple[Recipe[PolicyRecipe], ...]) -> None:
    for field in ("adapter", "default_n_action_steps", "needs_candidates"):
        values = [getattr(recipe.value, field) for recipe in recipes]
        other = next((i for i, value in enumerate(values) if value != values[0]), None)
        if other is not None:
            raise RecipeError(
                f"policies: {text}: expected checkpoints that differ in their training alone, found {field} "
                f"{values[0]} in {names[0]} and {values[other]} in {names[other]}. Give them different names."
            )
    for i, recipe in enumerate(recipes):
        same = next((j for j in range(i) if recipes[j].sha256 == recipe.sha256), None)
        if same is not None:
            raise RecipeError(
                f"policies: {text}: {names[same]} and {names[i]} are the same checkpoint, which would be "
                f"counted as two trainings. Name it once."
            )
