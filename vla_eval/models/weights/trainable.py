"""Choose by regular expressions which parameters are trained, and check that it is just these. Knows torch.

`target_modules="all-linear"` is refused: on a policy, peft then puts adapters on heads and embeddings, too.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any  # peft and lerobot are untyped

from torch import nn

from vla_eval.errors import TrainingError, did_you_mean
from vla_eval.models.weights.exact import listed

ALL_LINEAR = "all-linear"
_LORA = re.compile(r"^(?P<module>.+)\.lora_(?:A|B|embedding_A|embedding_B|magnitude_vector)\..+$")
_SAVED = re.compile(r"^(?P<module>.+)\.modules_to_save\.[^.]+\.(?P<rest>.+)$")


def matching(names: Iterable[str], patterns: Sequence[str], *, what: str) -> tuple[str, ...]:
    """Return the names that a pattern matches as a whole; each has to match one. `what` is the field."""
    known = tuple(names)
    found: dict[str, None] = {}
    for pattern in patterns:
        try:
            hits = [name for name in known if re.fullmatch(pattern, name)]
        except re.error as exc:
            raise TrainingError(f"{what}: '{pattern}' is not a regular expression: {exc}.") from exc
        if not hits:
            raise TrainingError(
                f"{what}: '{pattern}' matches none of {len(known)} names, such as "
                f"{', '.join(known[:3])}.{did_you_mean(pattern, known)} A pattern has to match a whole name."
            )
        found.update(dict.fromkeys(hits))
    return tuple(name for name in known if name in found)


def set_trainable(model: nn.Module, patterns: Sequence[str], *, what: str) -> tuple[str, ...]:
    """Train just the parameters that a pattern matches, see `matching`; return their names."""
    chosen = set(matching((name for name, _ in model.named_parameters()), patterns, what=what))
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name in chosen)
    return trainable(model)


def trainable(model: nn.Module) -> tuple[str, ...]:
    """Return the names of the parameters that a gradient step would change."""
    return tuple(name for name, parameter in model.named_parameters() if parameter.requires_grad)


def check_lora_target(target: str | None) -> None:
    """Raise `TrainingError` for a target that names no modules: `all-linear`."""
    if target == ALL_LINEAR:
        raise TrainingError(
            f"finetune.lora.target_modules is '{ALL_LINEAR}', which also takes heads and embeddings of a "
            f"policy. Write a regular expression of the modules' names."
        )


def check_lora(model: Any, target: str, full_modules: Sequence[str] = ()) -> tuple[str, ...]:
    """Check that just `full_modules` and `target`'s adapters are trained; return the modules with one."""
    check_lora_target(target)
    inner = model.get_base_model() if hasattr(model, "get_base_model") else model
    linear = [name for name, module in inner.named_modules() if hasattr(module, "lora_A")]
    plain = [name for name, module in inner.named_modules() if name and not _inside_adapter(name)]
    expected = matching(plain, [target], what="finetune.lora.target_modules")
    problems = {
        "named, but without an adapter": [name for name in expected if name not in linear],
        "with an adapter, but not named": [name for name in linear if name not in expected],
        "trained, but neither adapter nor named in full": [
            name for name in trainable(inner) if not _is_meant(name, linear, full_modules)
        ],
    }
    lines = [f"  {what}: {listed(names)}" for what, names in problems.items() if names]
    if lines:
        raise TrainingError("LoRA does not train what the recipe names:\n" + "\n".join(lines))
    return expected


def _inside_adapter(name: str) -> bool:
    return any(
        part.startswith("lora_") or part in ("base_layer", "modules_to_save") for part in name.split(".")
    )


def _is_meant(name: str, adapted: Sequence[str], full_modules: Sequence[str]) -> bool:
    adapter = _LORA.match(name)
    if adapter is not None:
        return adapter["module"] in adapted
    saved = _SAVED.match(name)
    return saved is not None and any(
        saved["module"] == module or saved["module"].endswith(f".{module}") for module in full_modules
    )
