"""What `config.json` may hold, asked before draccus decodes it, which makes 1 of true and 4 of "4"."""

import dataclasses
import math
import re
import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints  # Any: JSON, and types of lerobot's

from vla_eval.errors import CheckpointError
from vla_eval.strict.json_fields import FETCH_AGAIN, WORDS, get_count, wrong_type

MAX_ACTIONS = 10_000  # of a chunk or a history, in control steps: many times the longest episode
MOST: Mapping[str, int] = {"layers": 1_000, "depth": 1_000, "cameras": 100}
"""End of a field's name -> the largest number of what is made one by one, many times what there is."""
MAX_VALUES = 1 << 28  # of one field of an observation: a gigabyte in float32
REVISION = re.compile(r"(?!.*\.\.)\w[\w.+-]*(/[\w.+-]+)*", re.ASCII)
"""A branch, tag or commit of the Hub. Its client opens a file of that name in its cache."""
COUNTS = ("chunk_size", "n_action_steps", "horizon", "n_obs_steps", "window_steps")


def check_config(cls: type, data: Mapping[str, Any], *, where: str) -> None:
    """Compare the types of a file's fields, without `type`, with those of lerobot's class, exactly."""
    hints = get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name not in data:
            continue
        value, hint = data[field.name], hints[field.name]
        # lerobot writes `int = False` of a switch, and `str = None` of what may be left out.
        if not _fits(hint, value) and type(value) is not type(field.default):
            raise wrong_type(where, field.name, _described(hint), value)
        _check_most(where, field.name, value)
        if "revision" in field.name and isinstance(value, str) and not REVISION.fullmatch(value):
            raise wrong_type(where, field.name, "a branch, tag or commit", value)
    for name in COUNTS:
        get_count(data, name, maximum=MAX_ACTIONS, where=where)


def _check_most(where: str, name: str, value: object) -> None:
    """Refuse to make so many of something that there would be no end; within mappings, too."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_most(where, str(key), inner)
    most = next((most for end, most in MOST.items() if name.endswith(end)), None)
    if most is not None and type(value) is int and value > most:
        raise wrong_type(where, name, f"at most {most:,}", value)


def check_features(config: Any, *, where: str) -> None:
    """Raise `CheckpointError` for a policy without inputs or actions, or with impossible shapes."""
    for name in ("input_features", "output_features"):
        features = getattr(config, name) or {}
        if not features:
            raise CheckpointError(
                f"{where}: '{name}': expected a mapping of fields, found none. {FETCH_AGAIN}"
            )
        for key, feature in features.items():
            shape = feature.shape
            if any(type(size) is not int or size < 1 for size in shape) or math.prod(shape) > MAX_VALUES:
                raise CheckpointError(
                    f"{where}: '{name}.{key:.100}': expected a shape of at most {MAX_VALUES:,} numbers, "
                    f"found {shape!s:.100}. {FETCH_AGAIN}"
                )
    action = getattr(config, "action_feature", None)
    if action is None or len(action.shape) != 1:
        raise CheckpointError(
            f"{where}: 'output_features': expected an action of one dimension, found "
            f"{'none' if action is None else action.shape}. {FETCH_AGAIN}"
        )


def _fits(hint: Any, value: object) -> bool:
    if get_origin(hint) in (Union, types.UnionType):
        return any(_fits(option, value) for option in get_args(hint))
    if hint is float:
        return type(value) in (int, float)
    if (get_origin(hint) or hint) in (list, tuple, set):  # JSON has lists alone
        options = [option for option in get_args(hint) if option is not Ellipsis] or [Any]
        return isinstance(value, list) and all(any(_fits(o, item) for o in options) for item in value)
    if hint in WORDS:
        return type(value) is hint
    if get_origin(hint) is dict:
        return isinstance(value, dict) and all(_fits(get_args(hint)[1], item) for item in value.values())
    return True  # draccus decodes the rest by its own rules


def _described(hint: Any) -> str:
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(_described(option) for option in get_args(hint))
    name = getattr(hint, "__name__", str(hint))
    return WORDS.get(hint) or WORDS.get(get_origin(hint) or object) or name
