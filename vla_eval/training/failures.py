"""Which episodes of a dataset a policy learns from: whoever imitates leaves out those that failed."""

from dataclasses import replace
from pathlib import Path

from vla_eval.checkpoints.files import CONFIG_FILE, find_checkpoint, read_json
from vla_eval.checkpoints.loading import config_class
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.errors import DatasetError
from vla_eval.training.dataset import TrainingDataset


def chosen_episodes(dataset: TrainingDataset, recipe: FinetuneRecipe) -> TrainingDataset:
    """Return the dataset with the episodes named that are not trained on.

    Unless the recipe says what happens to those that failed, they are left out, except for a policy that is
    trained on rewards (`reward` of its configuration): it can tell them by these.

    Args:
        dataset: all of it.
        recipe: of the policy.

    Raises:
        DatasetError: no episode would be left.
    """
    if not dataset.failed:
        return dataset
    if recipe.failed_episodes == "keep" or (recipe.failed_episodes is None and _reads_rewards(recipe)):
        return dataset
    if len(dataset.failed) == dataset.meta.total_episodes:
        raise DatasetError(
            f"{dataset.root}: expected episodes to imitate, found none in which the success rule ever held "
            f"(of {dataset.meta.total_episodes}). Record others, or set finetune.failed_episodes to keep."
        )
    return replace(dataset, left_out=dataset.failed)


def _reads_rewards(recipe: FinetuneRecipe) -> bool:
    """Whether `reward` of the policy's configuration is set: by the recipe, its base, or its type."""
    field = config_class(recipe.type, where="finetune.type").__dataclass_fields__.get("reward")
    if field is None:
        return False
    reward = field.default
    if recipe.base_checkpoint is not None:
        reward = read_json(find_checkpoint(Path(recipe.base_checkpoint)) / CONFIG_FILE).get("reward", reward)
    return recipe.policy.get("reward", reward) is not None


def about_failures(dataset: TrainingDataset) -> str:
    """Return a line for a person: what is done with the episodes that failed."""
    done = "left out" if dataset.left_out else "kept"
    return f"failed episodes: {len(dataset.failed)} of {dataset.meta.total_episodes}, {done}"
