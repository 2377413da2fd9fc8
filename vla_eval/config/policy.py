"""`policies/*.yaml`: which code and which weights, under one name.

Some names of former recipes are rows of `configs/ablations.yaml` now; they still resolve.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from vla_eval.config.agents import AgentRecipe
from vla_eval.config.files import Recipe, load_recipe, search_folders, to_data
from vla_eval.config.finetuning import FinetuneRecipe, merge_fields
from vla_eval.errors import UnknownNameError
from vla_eval.strict.bounds import MAX_PROCESSES, Bounds, Steps, check_bounds
from vla_eval.strict.decoding import decode, load_yaml, warn_renamed

ABLATIONS = "ablations"


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyRecipe:
    """`policies/*.yaml`: which code and which weights, under one name."""

    version: int  # raised when a change of the recipe moves a success rate
    description: str
    adapter: str  # a name from the registry (`mikasa-vla list policies`) or `module:attr`
    args: dict[str, Any] = field(default_factory=dict)  # Any: whatever the adapter takes
    default_n_action_steps: Steps = 1  # actions executed per inference, where the evaluation names none
    # how many workers `workers: auto` may start, since each loads the policy
    max_workers: Annotated[int, Bounds(1, MAX_PROCESSES)] | None = None
    # the policy makes no sense for a task without candidates; such a pair is left out
    needs_candidates: bool = False
    # how weights for it are trained; None for policies that have nothing to train
    finetune: FinetuneRecipe | None = None
    # how an agent is trained by rewards
    train_agent: AgentRecipe | None = None

    def __post_init__(self) -> None:
        check_bounds(self)


def load_policy(name: str) -> Recipe[PolicyRecipe]:
    """Return the recipe of a policy, by a former name with a warning; errors as `load_recipe`."""
    try:
        return load_recipe("policies", name, PolicyRecipe)
    except UnknownNameError:
        stem = Path(name.removesuffix(".yaml")).name
        row = _ablation_rows().get(stem)
        if row is None:
            raise
    base = load_recipe("policies", row["policy"], PolicyRecipe)
    section = merge_fields(to_data(base.value.finetune), row["finetune"])
    warn_renamed(
        f"policies/{stem}.yaml",
        f"row {stem} of configs/{ABLATIONS}.yaml ({row['policy']} with finetune {row['finetune']}; "
        f"`mikasa-vla finetune {ABLATIONS} --policy {stem}`)",
    )
    value = replace(
        base.value,
        description=f"Row {stem} of configs/{ABLATIONS}.yaml.",
        default_n_action_steps=row["n_action_steps"][0],
        finetune=decode(FinetuneRecipe, section, where=f"configs/{ABLATIONS}.yaml, {stem}"),
    )
    return replace(base, name=stem, value=value)


def changed_section[T](
    recipe: Recipe[PolicyRecipe], name: str, cls: type[T], changes: Mapping[str, Any]
) -> Recipe[T]:
    """Return a section of a recipe, which has it, with values on top."""
    data = merge_fields(to_data(getattr(recipe.value, name)), changes)
    value = decode(cls, data, where=f"policies/{recipe.name}.yaml, {name}")
    return Recipe(name=recipe.name, path=recipe.path, sha256=recipe.sha256, value=value)


@functools.cache
def _ablation_rows() -> dict[str, Any]:  # Any: plain data of YAML
    """Return the rows that change something, by name: of the table that comes with the package."""
    path = search_folders("configs")[-1] / f"{ABLATIONS}.yaml"
    table = load_yaml(path.read_text(encoding="utf-8"), where=str(path))
    return {row["name"]: row for row in table["rows"] if "finetune" in row}
