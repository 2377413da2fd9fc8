"""Put weights into a model, exactly: same keys, shapes, types and, afterwards, values. Knows only torch."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any  # lerobot's policies are untyped

import torch
from torch import Tensor

from vla_eval.errors import CheckpointError

MAX_SHOWN = 8


def put_weights(
    policy: Any,
    weights: Mapping[str, Tensor],
    *,
    where: str,
    cast: bool = False,
    may_be_new: Sequence[str] = (),
) -> None:
    """Load the tensors into the policy, or raise and say which do not fit.

    Args:
        policy: a torch module; the values it has are overwritten.
        weights: its tensors by name; a tensor that the model has under several names may be there once.
        where: the file, for messages.
        cast: whether floating point types may differ, because the user chose another precision.
        may_be_new: beginnings of names; all tensors of one of them may be missing together and then stay
            as the constructor made them: a head that is new in fine-tuning.

    Raises:
        CheckpointError: keys are missing or unexpected, or shapes or types differ.
    """
    wanted: dict[str, Tensor] = dict(policy.state_dict())
    found = _renamed(policy, wanted, weights)
    new = tuple(start for start in may_be_new if not any(key.startswith(start) for key in found))
    missing = [key for key in _missing(wanted, found) if key not in found and not key.startswith(new)]
    problems = {
        "missing": missing,
        "unexpected": [key for key in found if key not in wanted],
        "of another shape": _differing(wanted, found, lambda tensor: tuple(tensor.shape)),
        "of another type": [] if cast else _differing(wanted, found, lambda tensor: tensor.dtype),
    }
    _refuse(problems, where)
    policy.load_state_dict(dict(found), strict=False)  # strictness is ours: it knows shared tensors
    check_same(policy.state_dict(), found, where=where, partial=True)


def check_same(
    actual: Mapping[str, Tensor], expected: Mapping[str, Tensor], *, where: str, partial: bool = False
) -> None:
    """Raise `CheckpointError` unless the tensors are those of the file, all finite.

    Args:
        actual: what the model holds.
        expected: what the file holds; compared in the model's type.
        where: the file, for messages.
        partial: whether the model may hold more.
    """
    problems = {
        "missing": [] if partial else [key for key in actual if key not in expected],
        "unexpected": [key for key in expected if key not in actual],
        "not taken over": [
            key
            for key, tensor in expected.items()
            if key in actual and not torch.equal(actual[key].cpu(), tensor.cpu().to(actual[key].dtype))
        ],
        "not finite": [
            key
            for key, tensor in expected.items()
            if tensor.is_floating_point() and not torch.isfinite(tensor).all()
        ],
    }
    _refuse(problems, where)


def _renamed(
    policy: Any, wanted: Mapping[str, Tensor], weights: Mapping[str, Tensor]
) -> Mapping[str, Tensor]:
    """Return the weights under the model's names, where the family has a rule for files of another origin."""
    if not _missing(wanted, weights) and all(key in wanted for key in weights):
        return weights
    fix: Callable[..., Mapping[str, Tensor]] | None = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if fix is None:
        return weights
    fixed = fix(dict(weights), policy.config)  # π0 family: names of openpi's own export
    return {key if key.startswith("model.") else f"model.{key}": tensor for key, tensor in fixed.items()}


def _missing(wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> list[str]:
    """Return the model's names without a tensor, those aside that share memory with one that has it."""
    present = {_place(wanted[key]) for key in found if key in wanted}
    return [key for key, tensor in wanted.items() if key not in found and _place(tensor) not in present]


def _place(tensor: Tensor) -> tuple[object, ...]:
    return (tensor.data_ptr(), tuple(tensor.shape), tensor.stride()) if tensor.numel() else (id(tensor),)


def _differing(
    wanted: Mapping[str, Tensor], found: Mapping[str, Tensor], of: Callable[[Tensor], object]
) -> list[str]:
    return [
        f"{key} (expected {of(wanted[key])}, found {of(tensor)})"
        for key, tensor in found.items()
        if key in wanted and of(wanted[key]) != of(tensor)
    ]


def _refuse(problems: Mapping[str, list[str]], where: str) -> None:
    lines = [f"  {len(keys)} {what}: {listed(keys)}" for what, keys in problems.items() if keys]
    if lines:
        raise CheckpointError(
            f"{where}: the weights are not those of this policy:\n"
            + "\n".join(lines)
            + "\nThe checkpoint and "
            "its config.json do not belong together, or another version of lerobot wrote it. Set `dtype` in "
            "the recipe's args if only the types differ and another precision is wanted."
        )


def listed(keys: Sequence[str]) -> str:
    """Return the first names, and how many more there are; for messages."""
    more = f" … and {len(keys) - MAX_SHOWN} more" if len(keys) > MAX_SHOWN else ""
    return ", ".join(keys[:MAX_SHOWN]) + more
