"""Find a published checkpoint, a base of recipes or on the Hub, and say how to get it. No network."""

import re
from dataclasses import replace
from pathlib import Path

from vla_eval.config.files import list_recipes
from vla_eval.config.policy import load_policy
from vla_eval.errors import MAX_SHOWN, CheckpointError, RecipeError, check_names
from vla_eval.models.families import bases
from vla_eval.models.family import Base, Source

FIRST_TRAININGS = ("recurrent_decisions",)
"""Shipped recipes whose trainings others start from, in a folder of that name."""


HUB = "hub:"
_HUB_ID = re.compile(r"hub:(?P<repo>[\w-][\w.-]*/[\w-][\w.-]*)(@(?P<revision>\w[\w./-]*))?")
_PATTERNS = ("*.json", "*.safetensors", "*.model", "*.txt")  # of tokenizers; no code, no pickles
FOLDER = Path("checkpoints")


def hub_folder(name: str) -> Path | None:
    """Return where `hub:OWNER/NAME@REVISION` lies once it is fetched; None for another name."""
    if not name.startswith(HUB):
        return None
    match = _HUB_ID.fullmatch(name)
    if match is None:
        raise RecipeError(
            f"expected hub:OWNER/NAME or hub:OWNER/NAME@REVISION, such as hub:lerobot/smolvla_base, found "
            f"'{name:.{MAX_SHOWN}}'."
        )
    return FOLDER / name.removeprefix(HUB).replace("/", "--")


def _of_hub(name: str, folder: Path) -> Base:
    """Return what is fetched for a Hub id: of a known base also its tokenizer and the like."""
    repo, _, revision = name.removeprefix(HUB).partition("@")
    known = next((base for base in bases().values() if base.weights.repo_id == repo), None)
    if known is not None and (known.options is not None or known.is_backbone):
        raise CheckpointError(
            f"{name:.{MAX_SHOWN}}: expected a LeRobot checkpoint, found {known.title}, which is none."
            f"{how_to_get(known.name)}"
        )
    weights = Source(repo_id=repo, revision=None, patterns=_PATTERNS) if known is None else known.weights
    weights = replace(weights, revision=revision or weights.revision)
    if known is not None:
        return replace(known, name=folder.name, parts=(*known.parts[:-1], weights))
    return Base(name=folder.name, title=repo, terms="see its page on the Hub", parts=(weights,))


def base_of_recipe(recipe: str) -> str | None:
    """Return the published base that a recipe in `policies/` starts from; None: it starts from none."""
    if recipe not in list_recipes("policies"):
        return None
    section = load_policy(recipe).value.finetune
    name = Path(str(section and section.base_checkpoint)).name
    return name if name in bases() else None


def find_base(name: str) -> Base:
    """Return a base by the name of its folder or of a recipe, or what a Hub id names."""
    if (folder := hub_folder(name)) is not None:
        return _of_hub(name, folder)
    known = bases()
    found = name if name in known else base_of_recipe(name)
    check_names("base checkpoint", [found or name], known)
    return known[found or name]


def how_to_get(path: str | Path) -> str:
    """Return a sentence with the command that makes what lies at a path; empty if no base has its name."""
    if hub_folder(str(path)) is not None:
        return f" Get it: mikasa-vla checkpoint fetch {path!s:.{MAX_SHOWN}}."
    name = Path(path).name
    if name in bases():
        return f" Get it: mikasa-vla checkpoint fetch {name}."
    if name in FIRST_TRAININGS:
        return f" Train it first: mikasa-vla finetune --policy {name} --dataset DATASET --out {path!s:.300}."
    return ""


def no_weights(recipe: str) -> CheckpointError:
    """Build the error for a recipe that says how a policy is trained, and has no weights yet."""
    if recipe in list_recipes("policies") and load_policy(recipe).value.train_agent is not None:
        return CheckpointError(
            f"policy '{recipe}' has no weights: its recipe says how it learns by rewards. Run `mikasa-vla "
            f"train-agent --policy {recipe} --task TASK --out RUN`, then `mikasa-vla eval --policy RUN`."
        )
    base = base_of_recipe(recipe)
    first = "" if base is None else f" It starts from a base: first `mikasa-vla checkpoint fetch {base}`."
    return CheckpointError(
        f"policy '{recipe}' has no weights: its recipe says how to fine-tune it.{first} Run "
        f"`mikasa-vla finetune --policy {recipe} --dataset DIR --out RUN`, then `mikasa-vla eval --policy "
        "RUN`; or name a folder with `checkpoint` in the recipe's args."
    )
