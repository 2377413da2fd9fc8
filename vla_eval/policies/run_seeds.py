"""A policy of several checkpoints, `NAME=A,B,C`: the same training with different run seeds, one run each."""

from dataclasses import dataclass

from vla_eval.config.files import Recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import RecipeError
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.storage.planned import named_checkpoints
from vla_eval.wire.addresses import named_server


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyEntry:
    """One entry of a configuration's `policies`.

    Attributes:
        name: what records call it.
        recipes: one; or one per run, for a policy of several checkpoints.
        texts: what the configuration calls each of them.
        is_by_run: whether each recipe is a run of its own.
    """

    name: str
    recipes: tuple[Recipe[PolicyRecipe], ...]
    texts: tuple[str, ...]
    is_by_run: bool = False

    @property
    def value(self) -> PolicyRecipe:
        """What all its recipes agree on: the code, and for which tasks it is."""
        return self.recipes[0].value

    def part(self, index: int) -> str:
        """Return the name of a recipe in `run.json`: those of several checkpoints are numbered."""
        return f"{self.name}/run-{index}" if self.is_by_run else self.name


def load_policy_entry(text: str) -> PolicyEntry:
    """Return the policy that an entry of a configuration names.

    Args:
        text: see `load_policy_recipe`; or `NAME=A,B,C` with such a text for each run.

    Raises:
        UnknownNameError, RecipeError, CheckpointError, RemotePolicyError: see `load_policy_recipe`.
        RecipeError: the checkpoints of one policy are not of the same kind, or one stands there twice.
    """
    named = named_checkpoints(text)
    if named is None:
        recipe = load_policy_recipe(text)
        return PolicyEntry(name=recipe.name, recipes=(recipe,), texts=(text,))
    served = [one for one in named.checkpoints if named_server(one) is not None]
    if served:
        raise RecipeError(
            f"policies: {text}: expected folders of checkpoints or names in policies/, found {served[0]}. "
            f"Give a policy server without a name and '='."
        )
    recipes = tuple(load_policy_recipe(one) for one in named.checkpoints)
    _check_alike(text, named.checkpoints, recipes)
    return PolicyEntry(name=named.name, recipes=recipes, texts=named.checkpoints, is_by_run=True)


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
