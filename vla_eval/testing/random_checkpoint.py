"""A checkpoint of random weights, made part by part, at a recipe's true size; tokenizers are stand-ins."""

import contextlib
import functools
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from lerobot.policies import make_pre_post_processors
from torch import Tensor

from vla_eval.checkpoints.files import WEIGHTS_FILE, TrainingFacts, write_facts
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.processors import save_tokenizers, save_vlm_files
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.errors import CheckpointError
from vla_eval.features import ACTION_KEY, ACTION_NAMES, CAMERA_KEYS, IMAGE_SHAPE
from vla_eval.models.families import family_of
from vla_eval.models.family import imported
from vla_eval.models.weights.file import write_weights
from vla_eval.training.dry_run import assumed_config
from vla_eval.training.model import tokenizer_from

TASK = "RememberColor3-v0"
SPREAD = 0.02  # standard deviation of random weights, as transformers initialises them
PART = 1 << 24  # numbers that are made at once


def stand_in_config(
    recipe: FinetuneRecipe, folder: Path, *, dtype: str | None, tiny: bool
) -> tuple[Any, Path | None]:
    """Return a policy's configuration, with stand-ins for what it names, and a tokenizer's folder or None."""
    family = family_of(recipe.type)
    changes: dict[str, Any] = {
        name: {**value, **recipe.policy.get(name, {})} if isinstance(value, Mapping) else value
        for name, value in family.stand_in_fields.items()
    }
    tokenizer: Path | None = None
    if family.stand_in:
        made, tokenizer = imported(family.stand_in)(folder, tiny)
        changes |= made
    if dtype is not None:
        changes["dtype"] = dtype
    base = recipe.base_checkpoint
    changed = FinetuneRecipe(type=recipe.type, policy={**recipe.policy, **changes}, base_checkpoint=base)
    return assumed_config(changed), tokenizer


@contextlib.contextmanager
def published_sizes() -> Iterator[Callable[[FinetuneRecipe], Any]]:
    """Yield a function from a recipe to its configuration at published size, without base or network."""
    with tempfile.TemporaryDirectory() as folder:
        yield lambda recipe: stand_in_config(
            recipe, Path(tempfile.mkdtemp(dir=folder)), dtype=None, tiny=False
        )[0]


def write_checkpoint(folder: Path, config: Any, policy: Any, tokenizer: Path | None) -> None:
    """Write a checkpoint of random weights, as a fine-tuning would."""
    state = policy.state_dict(keep_vars=True)
    # A shared one is written under its first name.
    once = {id(tensor): name for name, tensor in reversed(state.items())}
    described = {name: state[name] for name in state if once[id(state[name])] == name}
    write_weights(folder / WEIGHTS_FILE, described, functools.partial(random_parts, described))
    config._save_pretrained(folder)
    own = contextlib.nullcontext() if tokenizer is None else tokenizer_from(str(tokenizer), config)
    with own, no_foreign_code(config.type):
        processors = make_pre_post_processors(config, dataset_stats=plain_statistics(config))
    for processor in processors:
        processor.save_pretrained(folder)
    save_tokenizers(processors[0], folder)
    save_vlm_files(config, folder)
    height, width, _ = IMAGE_SHAPE
    write_facts(
        folder,
        TrainingFacts(
            run="rehearsal",
            dataset="none",
            dataset_sha256="0" * 64,
            task=TASK,
            state="eef",
            images=dict.fromkeys(CAMERA_KEYS.values(), (height, width)),
            fps=20.0,
            action_names=ACTION_NAMES,
            control_mode="pd_ee_delta_pose",
            run_seed=0,
        ),
    )


def random_parts(described: Mapping[str, Tensor], name: str) -> Iterator[Tensor]:
    """Yield a tensor's numbers in order: random, of a deviation of 0.02, or its own if it has memory."""
    tensor = described[name]
    if not tensor.is_meta:  # a buffer, whose values the constructor has computed
        yield tensor.detach()
        return
    draws = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    for begin in range(0, max(1, tensor.numel()), PART):
        n = min(PART, tensor.numel() - begin)
        yield torch.empty(n).normal_(0.0, SPREAD, generator=draws).to(tensor.dtype)


def plain_statistics(config: Any) -> dict[str, dict[str, Any]]:
    """Return statistics that leave numbers about as they are."""
    values = {"mean": 0.0, "std": 1.0, "min": -1.0, "max": 1.0, "q01": -1.0, "q99": 1.0}
    shapes = {key: tuple(x.shape) for key, x in {**config.input_features, **config.output_features}.items()}
    shapes = {
        key: (shape[0], 1, 1) if len(shape) == len(IMAGE_SHAPE) else shape for key, shape in shapes.items()
    }
    assert shapes[ACTION_KEY] == (len(ACTION_NAMES),)
    return {
        key: {name: torch.full(shape, value).numpy() for name, value in values.items()}
        for key, shape in shapes.items()
    }


@contextlib.contextmanager
def built_tiny(kind: str, *, tiny: bool) -> Iterator[None]:
    """Let lerobot build a type in its tiny form within the context, if asked; raise if it has none."""
    family = family_of(kind)
    if not tiny:
        yield
    elif family.built_tiny:
        with imported(family.built_tiny)(family.lerobot_type):
            yield
    else:
        raise CheckpointError(
            f"--tiny is for the π0 family and SmolVLA; '{kind}' has recipes of its own that are tiny."
        )
