"""Whether a run that is started again has its episodes and more, and the command that puts it beside instead.

The records of a run that has grown are those of a run that had all episodes from the start.
"""

import itertools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from vla_eval.storage.run_file import JsonValue, RunDescription

GROWING = ("tasks", "task_versions", "policies", "policy_names", "n_action_steps", "episodes", "runs")
"""Fields of a configuration of which more is a plan with more episodes."""
OUT_FLAG = "--out"


def without_growth(new: RunDescription, old: RunDescription) -> RunDescription:
    """Return `new` without what it only adds to `old`: what still differs changes what was run."""
    config = {
        name: old.config[name] if name in GROWING and _covers(value, old.config.get(name)) else value
        for name, value in new.config.items()
    }
    return replace(
        new,
        config=config,
        recipes={name: digest for name, digest in new.recipes.items() if name in old.recipes},
        servers={name: server for name, server in new.servers.items() if name in old.servers},
    )


def _covers(new: JsonValue, old: JsonValue) -> bool:
    """Whether a plan with the new value has all episodes of one with the old value."""
    match new, old:
        case int(), int():
            return new >= old
        case Mapping(), Mapping():
            return all(new.get(key) == value for key, value in old.items())
        case (str(), _) | (_, str()):
            return False
        case Sequence(), Sequence():
            return all(any(_continues(one, item) for one in new) for item in old)
    return False


def _continues(new: JsonValue, old: JsonValue) -> bool:
    """Whether an item is the same, or a policy of several checkpoints, `NAME=A,B`, with further ones."""
    is_longer = isinstance(new, str) and isinstance(old, str) and "=" in old and new.startswith(f"{old},")
    return new == old or is_longer


def command_beside(command: str, out: Path) -> str:
    """Return the command that the user typed, with a free folder next to `out`."""
    words = shlex.split(command)
    beside = (out.with_name(f"{out.name}-{n}") for n in itertools.count(2))
    free = next(path for path in beside if not path.exists())
    kept: list[str] = []
    skips = False
    for word in words:
        if not skips and word != OUT_FLAG and not word.startswith(f"{OUT_FLAG}="):
            kept.append(word)
        skips = word == OUT_FLAG
    return shlex.join([*kept, OUT_FLAG, str(free)])
