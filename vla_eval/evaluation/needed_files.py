"""What a cluster's machines must have before an evaluation: checkpoints; the small ones are sent."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from vla_eval.checkpoints.files import SHIPPED_FOLDER, adapter_bases, checkpoint_sha256, find_checkpoint
from vla_eval.checkpoints.notes import CHECKPOINTS
from vla_eval.config.files import search_folders
from vla_eval.policies.entries import PolicyEntry
from vla_eval.workers.needed_files import Needed
from vla_eval.workers.parcel import fits

CHECKPOINT_ARGS = ("checkpoint", "base_checkpoint")


def needed_files(policies: Sequence[PolicyEntry]) -> tuple[Needed, ...]:
    """Return the checkpoints that the policies of an evaluation load; `CheckpointError`: one is not here."""
    recipes = [recipe.value for policy in policies for recipe in policy.recipes]
    own = [recipe for recipe in recipes if recipe.adapter in CHECKPOINTS]
    named = [recipe.args.get(arg) for recipe, arg in product(own, CHECKPOINT_ARGS)]
    return tuple(
        Needed(
            path=path,
            sha256=checkpoint_sha256(Path(path)),
            digest=checkpoint_sha256,
            folders=_to_send(Path(path)),
        )
        for path in dict.fromkeys(path for path in named if isinstance(path, str))
    )


def _to_send(checkpoint: Path) -> tuple[str, ...]:
    """Return the folders of a checkpoint that is small enough to be sent; those of the package are there."""
    folder = find_checkpoint(checkpoint)
    folders = [folder, *adapter_bases(folder)]
    shipped = search_folders(SHIPPED_FOLDER)[-1].resolve()
    if any(part.resolve().is_relative_to(shipped) for part in folders) or not fits(folders):
        return ()
    here = Path.cwd()
    return tuple(str(part.relative_to(here) if part.is_relative_to(here) else part) for part in folders)
