"""Find a published checkpoint that recipes start from (rows of `models.families`), and say how to get it.

No network: `fetching` fetches them.
"""

from pathlib import Path

from vla_eval.config.files import list_recipes
from vla_eval.config.policy import load_policy
from vla_eval.errors import check_names
from vla_eval.models.families import bases
from vla_eval.models.family import Base

FIRST_TRAININGS = ("recurrent_decisions",)
"""Shipped recipes whose trainings others start from, in a folder of that name."""


def base_of_recipe(recipe: str) -> str | None:
    """Return the published base that a recipe in `policies/` starts from; None: it starts from none."""
    if recipe not in list_recipes("policies"):
        return None
    section = load_policy(recipe).value.finetune
    name = Path(str(section and section.base_checkpoint)).name
    return name if name in bases() else None


def find_base(name: str) -> Base:
    """Return a base by the name of its folder or of a recipe; raise `UnknownNameError` if there is none."""
    known = bases()
    found = name if name in known else base_of_recipe(name)
    check_names("base checkpoint", [found or name], known)
    return known[found or name]


def how_to_get(path: str | Path) -> str:
    """Return a sentence with the command that makes what lies at a path; empty if no base has its name."""
    name = Path(path).name
    if name in bases():
        return f" Get it: mikasa-vla checkpoint fetch {name}."
    if name in FIRST_TRAININGS:
        return f" Train it first: mikasa-vla finetune --policy {name} --dataset DATASET --out {path!s:.300}."
    return ""


def first_fetch(recipe: str) -> str:
    """Return a sentence with the command that fetches the base of a recipe; empty if it has none."""
    base = base_of_recipe(recipe)
    return "" if base is None else f" It starts from a base: first `mikasa-vla checkpoint fetch {base}`."
