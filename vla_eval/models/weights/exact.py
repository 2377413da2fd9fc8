"""Put weights into a model, exactly: same keys, shapes, types and, afterwards, values. Knows only torch.

Ours, since lerobot loads with `strict=False`, and torch's own strictness casts types without a word.
One tensor after the other: a model is not in memory twice while it is loaded.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any  # lerobot's policies are untyped

import torch
from torch import Tensor, nn

from vla_eval.errors import CheckpointError
from vla_eval.models.weights.file import describe

MAX_SHOWN = 8
CHUNK = 1 << 24  # numbers that are looked at at once


def put_weights(
    policy: Any,
    weights: Mapping[str, Tensor],
    *,
    where: str,
    cast: bool = False,
    may_be_new: Sequence[str] = (),
    device: str = "cpu",
) -> None:
    """Load the tensors into the policy, or raise and say which do not fit.

    Args:
        policy: a torch module; the values it has are overwritten.
        weights: its tensors by name; a tensor that the model has under several names may be there once.
        where: the file, for messages.
        cast: whether floating point types may differ, because the user chose another precision.
        may_be_new: beginnings of names; all tensors of one of them may be missing together and then stay
            as the constructor made them. Those without memory become NaN: an adapter that brings them is
            loaded next.
        device: where parameters without memory (`empty_weights`) get it.
    """
    sources = check_fit(policy, weights, where=where, cast=cast, may_be_new=may_be_new)
    wanted: dict[str, Tensor] = dict(policy.state_dict(keep_vars=True))
    owners = _owners(policy)
    bad: dict[str, list[str]] = {"not taken over": [], "not finite": []}
    taken: dict[tuple[object, ...], str] = {}
    for key, name in sources.items():
        tensor, target = weights[name], wanted[key]
        has_fractions = tensor.is_floating_point()  # whole numbers are finite
        if has_fractions and not all(bool(torch.isfinite(part).all()) for part in _parts(tensor)):
            bad["not finite"].append(key)
        place = _place(target)
        if place in taken:  # the file has one tensor under two names, or two where the model has one
            same = _is_same(tensor, weights[sources[taken[place]]])
        else:
            taken[place] = key
            same = _take(owners, target, tensor, device)
        if not same:
            bad["not taken over"].append(key)
    _refuse(bad, where)
    for name, parameter in policy.named_parameters():
        if parameter.is_meta:
            assert name.startswith(tuple(may_be_new)), name  # what else is missing was refused above
            unknown = torch.full(parameter.shape, torch.nan, dtype=parameter.dtype)
            _take(owners, parameter, unknown, device)


def check_fit(
    policy: Any,
    weights: Mapping[str, Tensor],
    *,
    where: str,
    cast: bool = False,
    may_be_new: Sequence[str] = (),
) -> dict[str, str]:
    """Compare names, shapes and types as `put_weights` does; return name in the policy -> in the weights."""
    wanted: dict[str, Tensor] = dict(policy.state_dict(keep_vars=True))
    described = describe(weights)
    sources = _sources(policy, wanted, described)
    found = {key: described[name] for key, name in sources.items()}
    new = tuple(start for start in may_be_new if not any(key.startswith(start) for key in found))
    missing = [key for key in _missing(wanted, found) if key not in found and not key.startswith(new)]
    problems = {
        "missing": missing,
        "unexpected": [key for key in found if key not in wanted],
        "of another shape": _differing(wanted, found, lambda tensor: tuple(tensor.shape)),
        "of another type": [] if cast else _differing(wanted, found, lambda tensor: tensor.dtype),
    }
    _refuse(problems, where)
    return sources


def check_same(actual: Mapping[str, Tensor], expected: Mapping[str, Tensor], *, where: str) -> None:
    """Raise `CheckpointError` unless a model has the file's tensors, finite."""
    problems = {
        "missing": [key for key in actual if key not in expected],
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


def _sources(policy: Any, wanted: Mapping[str, Tensor], described: Mapping[str, Tensor]) -> dict[str, str]:
    """Return the weights' names by the model's, where the family has a rule for files of another origin."""
    if not _missing(wanted, described) and all(key in wanted for key in described):
        return {key: key for key in described}
    fix: Callable[..., Mapping[str, Tensor]] | None = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if fix is None:
        return {key: key for key in described}
    sources: dict[str, str] = {}
    for name, tensor in described.items():  # π0 family: names of openpi's own export
        # By itself, and without values: the rule renames, leaves out, or gives one tensor two names.
        fixed = fix({name: torch.empty_like(tensor, device="meta")}, policy.config)
        for key in fixed:
            sources[key if key.startswith("model.") else f"model.{key}"] = name
    return sources


def _missing(wanted: Mapping[str, Tensor], found: Mapping[str, Tensor]) -> list[str]:
    """Return the model's names without a tensor, those aside that share memory with one that has it."""
    present = {_place(wanted[key]) for key in found if key in wanted}
    return [key for key, tensor in wanted.items() if key not in found and _place(tensor) not in present]


def _place(tensor: Tensor) -> tuple[object, ...]:
    """Return what two names of one tensor have in common; the tensor is the module's own, not detached."""
    if tensor.is_meta or not tensor.numel():
        return (id(tensor),)
    return (tensor.data_ptr(), tuple(tensor.shape), tensor.stride())


def _owners(policy: nn.Module) -> dict[int, list[tuple[nn.Module, str]]]:
    """Return, by the identity of a parameter without memory, the modules that have it and their names."""
    owners: dict[int, list[tuple[nn.Module, str]]] = {}
    for module in policy.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None and parameter.is_meta:
                owners.setdefault(id(parameter), []).append((module, name))
    return owners


@torch.no_grad()
def _take(
    owners: Mapping[int, list[tuple[nn.Module, str]]], target: Tensor, tensor: Tensor, device: str
) -> bool:
    """Give a parameter its values; return whether it has just these."""
    if not target.is_meta:
        target.copy_(tensor)
        return _is_same(target, tensor)
    made = nn.Parameter(tensor.to(device=device, dtype=target.dtype), requires_grad=target.requires_grad)
    made.__dict__.update(target.__dict__)
    for module, name in owners[id(target)]:
        module._parameters[name] = made
    return True


def _is_same(actual: Tensor, expected: Tensor) -> bool:
    pairs = zip(_parts(actual), _parts(expected), strict=True)
    return all(torch.equal(part.cpu(), other.cpu().to(part.dtype)) for part, other in pairs)


def _parts(tensor: Tensor) -> tuple[Tensor, ...]:
    """Return a tensor in parts of limited size: comparing needs memory of its own."""
    flat = tensor.detach().reshape(-1)
    return tuple(flat[start : start + CHUNK] for start in range(0, max(1, flat.numel()), CHUNK))


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
