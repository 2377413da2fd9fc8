"""A published checkpoint of another program, as a converter reads it: safetensors, none of its code."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # JSON, lerobot and transformers

from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from vla_eval.errors import CheckpointError, did_you_mean
from vla_eval.features import ACTION_KEY, ACTION_NAMES, STATE_KEY
from vla_eval.models.shared.gripper import ENCODINGS, GripperEncoding
from vla_eval.models.weights.file import WeightFile
from vla_eval.strict.json_text import shown

CONFIG_FILE = "config.json"
Statistics = dict[str, dict[str, Any]]
"""Field -> statistic -> one number per dimension."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Original:
    """What a converter has found."""

    config: Any
    # function from the policy, without values, to its tensors by name
    weights: Callable[[Any], Mapping[str, Tensor]]
    make_processors: Callable[[], tuple[Any, Any]]  # makes pre- and postprocessor from the configuration
    casts: bool = False  # whether types of numbers may differ from the configuration's
    # is given the tokenizer, whose files are copied, and raises if it is not the model's; None: the
    # configuration names the tokenizer
    check_tokenizer: Callable[[Any], None] | None = None


def with_features[C](config: C, cameras: Mapping[str, tuple[int, int]], *, state: int = 0) -> C:
    """Return a configuration with our datasets' fields: cameras' (height_px, width_px), `state` numbers."""
    fields = {
        name: PolicyFeature(type=FeatureType.VISUAL, shape=(3, *size)) for name, size in cameras.items()
    }
    if state:
        fields[STATE_KEY] = PolicyFeature(type=FeatureType.STATE, shape=(state,))
    made: Any = config  # lerobot, whose fields it has, is untyped
    made.input_features = fields
    made.output_features = {ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),))}
    return config


def read_safetensors(source: Path) -> dict[str, Tensor]:
    """Return all tensors of a folder's safetensors files, of which there has to be one."""
    files = sorted(source.glob("*.safetensors"))
    if not files:
        raise CheckpointError(f"{source}: expected safetensors, found none. Fetch the whole checkpoint.")
    weights: dict[str, Tensor] = {}
    for file in files:
        weights.update(WeightFile(file))
    return weights


def chosen_statistics(source: Path, known: Mapping[str, Any], unnorm_key: str | None) -> Any:
    """Return the statistics of one dataset; None if there are several and none is chosen."""
    if unnorm_key is None:
        return next(iter(known.values())) if len(known) == 1 else None
    if unnorm_key not in known:
        raise CheckpointError(
            f"{source}: there are no statistics '{unnorm_key}'.{did_you_mean(unnorm_key, known)} There are: "
            f"{', '.join(known) or 'none'}."
        )
    return known[unnorm_key]


def stated_gripper(source: Path, stated: str | None) -> GripperEncoding:
    """Return how a published policy encodes the gripper, which no file says: it is stated."""
    for encoding in ENCODINGS:
        if stated == encoding:
            return encoding
    found = "nothing." if stated is None else f"'{stated}'.{did_you_mean(stated, ENCODINGS)}"
    raise CheckpointError(
        f"{source}: expected how its data encode the gripper (--gripper), found {found} Its files do not "
        "say it, and another encoding would execute “closed” as half open. unit_open: 0 closed to 1 open, as "
        "in Open X-Embodiment and so in the published OpenVLA and Octo; unit_closed: the opposite; "
        "maniskill: -1 closed to 1 open; negated: -1 open to 1 closed."
    )


def read_mask(source: Path, what: str, statistics: Mapping[str, Any], n_dims: int) -> tuple[bool, ...]:
    """Return which dimensions are normalised; all, where the statistics do not say it."""
    mask = statistics.get("mask", [True] * n_dims)
    is_mask = isinstance(mask, list) and all(isinstance(value, bool) for value in mask)
    if not is_mask or len(mask) != n_dims:
        raise CheckpointError(
            f"{source}: mask of {what}: expected {n_dims} times true or false, found {shown(mask)}."
        )
    return tuple(mask)


def check_mask(source: Path, what: str, statistics: Mapping[str, Any], expected: tuple[bool, ...]) -> None:
    """Raise `CheckpointError` for statistics that normalise other dimensions than expected."""
    mask = statistics.get("mask")
    if mask is not None and tuple(mask) != expected:
        raise CheckpointError(f"{source}: mask of {what}: expected {expected}, found {tuple(mask)}.")
