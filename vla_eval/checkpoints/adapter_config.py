"""What `adapter_config.json` of a LoRA adapter may say, checked before peft is given anything of it."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # peft is untyped

from vla_eval.errors import CheckpointError
from vla_eval.strict.json_fields import (
    FETCH_AGAIN,
    get_count,
    get_mapping,
    get_text,
    get_texts,
    read_json,
    wrong_type,
)
from vla_eval.strict.json_text import shown

MAX_RANK = 16_384
NAMES = ("target_modules", "exclude_modules")
"""A regular expression of modules' names, or a list of names."""
SWITCHES = ("use_rslora", "use_dora", "lora_bias", "fan_in_fan_out")
PATTERNS = ("rank_pattern", "alpha_pattern")
BIASES = ("none", "all", "lora_only")
BASE = "base_model_name_or_path"
"""Passed on only to be saved with the next checkpoint; `adapter_base` reads it."""
NOT_PASSED_ON = frozenset({"auto_mapping", "inference_mode", "peft_type", "peft_version", "revision"})
BEGINNING = "init_lora_weights"
KEEPS_BASE = (None, True, False, "gaussian", "orthogonal")
"""Beginnings of a training that left the weights of its base alone; the saved weights replace them."""
NUMBERS = ("lora_alpha", "lora_dropout")
LOOKED_AT = frozenset(
    {*NAMES, *SWITCHES, *PATTERNS, *NUMBERS, BASE, BEGINNING, "r", "modules_to_save", "bias"}
)


def read_adapter_config(path: Path) -> Any:
    """Return peft's configuration of an adapter, which has to be plain LoRA; else raise `CheckpointError`."""
    from peft import LoraConfig  # optional extra of lerobot

    data = read_json(path)
    fields = lora_fields(data, where=str(path))
    defaults: Any = LoraConfig()
    known = {field.name: getattr(defaults, field.name) for field in dataclasses.fields(LoraConfig)}
    for name, value in data.items():
        if name in NOT_PASSED_ON or name in LOOKED_AT:
            continue
        if value not in (None, known.get(name), {}, [], False):
            raise CheckpointError(
                f"{path}: '{name}': expected peft's default, found {shown(value)}. Only plain LoRA is "
                "loaded. Merge the adapter into its base with the program that made it (docs/security.md)."
            )
    return LoraConfig(**fields)


def lora_fields(data: Mapping[str, Any], *, where: str) -> dict[str, Any]:
    """Return the fields that peft is given; `CheckpointError` for one of another type or range."""
    if data.get("peft_type") != "LORA":
        raise CheckpointError(
            f"{where}: 'peft_type': expected 'LORA', found {shown(data.get('peft_type'))}. {FETCH_AGAIN}"
        )
    fields: dict[str, Any] = {name: _names(data, name, where) for name in NAMES}
    fields["r"] = get_count(data, "r", maximum=MAX_RANK, where=where)
    fields["modules_to_save"] = get_texts(data, "modules_to_save", where=where) or None
    fields |= {name: _number(data, name, where) for name in NUMBERS}
    fields |= {name: _switch(data, name, where) for name in SWITCHES}
    for name in PATTERNS:
        pattern = get_mapping(data, name, where=where)
        fields[name] = {key: _number(pattern, key, f"{where}: {name}") for key in pattern}
    if data.get("bias", "none") not in BIASES:
        raise wrong_type(where, "bias", " or ".join(BIASES), data["bias"])
    fields["bias"] = data.get("bias")
    if data.get(BEGINNING) not in KEEPS_BASE:
        raise wrong_type(where, BEGINNING, "true, false, 'gaussian' or 'orthogonal'", data[BEGINNING])
    fields[BASE] = get_text(data, BASE, where=where)
    return {name: value for name, value in fields.items() if value is not None}


def _names(data: Mapping[str, Any], key: str, where: str) -> str | list[str] | None:
    value = data.get(key)
    return value if isinstance(value, str) else get_texts(data, key, where=where) or None


def _number(data: Mapping[str, Any], key: str, where: str) -> float | None:
    value = data.get(key)
    if value is not None and (type(value) not in (int, float) or not 0 <= value <= 1e6):
        raise wrong_type(where, key, "a number from 0 to 1,000,000", value)
    return value


def _switch(data: Mapping[str, Any], key: str, where: str) -> bool | None:
    value = data.get(key)
    if value is not None and not isinstance(value, bool):
        raise wrong_type(where, key, "true or false", value)
    return value
