"""The description of a processor as a checkpoint has it, read without torch; `safe_processors` makes it."""

import os
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # JSON of another program

from safetensors import safe_open

from vla_eval.checkpoints.files import (
    CONFIG_FILE,
    POSTPROCESSOR_FILE,
    PREPROCESSOR_FILE,
    WEIGHTS_FILE,
    unreadable,
)
from vla_eval.errors import CheckpointError
from vla_eval.strict.json_fields import FETCH_AGAIN, get_mapping, get_text, read_json, wrong_type
from vla_eval.strict.json_text import shown

STATE_SUFFIX = ".safetensors"
HUB_SNAPSHOTS, HUB_BLOBS = "snapshots", "blobs"
BUILT_IN = (
    *("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.", "unnormalize_targets."),
    *("normalize.", "unnormalize.", "input_normalizer.", "output_normalizer.", "normalalize_inputs."),
)
"""Beginnings of the names of normalising layers, which LeRobot had before its processors. Source:
https://github.com/huggingface/lerobot/blob/v0.6.1/src/lerobot/processor/migrate_policy_normalization.py"""
BUILT_IN_STATISTICS = (".mean", ".std", ".min", ".max")
MIGRATE = "python -m lerobot.processor.migrate_policy_normalization"


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedStep:
    """One step."""

    registry_name: str | None  # under which lerobot knows the step; None: `imported` names it
    imported: str | None  # module and class
    config: Mapping[str, Any]  # arguments of its constructor, plain data
    state_file: Path | None  # of its tensors, inside the checkpoint; None: it has none
    where: str  # file and position, for messages

    @property
    def name(self) -> str:
        """What lerobot addresses the step by: its registered name, or its class."""
        return self.registry_name or str(self.imported).rpartition(".")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedProcessor:
    """A pipeline of steps in their order, the file that describes it, and lerobot's name of it."""

    path: Path
    title: str
    steps: tuple[SavedStep, ...]

    def names(self) -> tuple[str, ...]:
        """Return what lerobot addresses the steps by."""
        return tuple(step.name for step in self.steps)


def read_saved_processor(path: Path) -> SavedProcessor:
    """Read a processor's description; nothing is imported. Files that it names lie in the checkpoint."""
    if path.parent.is_dir() and not path.exists():
        refuse_built_in_normalization(path.parent)
        raise _missing(path)
    data = read_json(path)
    steps = data.get("steps")
    if not isinstance(steps, list):
        raise wrong_type(str(path), "steps", "a list", steps)
    return SavedProcessor(
        path=path,
        title=get_text(data, "name", where=str(path)) or "processor",
        steps=tuple(_step(path, index, step) for index, step in enumerate(steps)),
    )


def _step(path: Path, index: int, step: object) -> SavedStep:
    where = f"{path}: step {index + 1}"
    if not isinstance(step, dict):
        raise CheckpointError(f"{where}: expected a mapping, found {shown(step)}. {FETCH_AGAIN}")
    registry_name, imported = (get_text(step, key, where=where) for key in ("registry_name", "class"))
    if not registry_name and not imported:
        raise CheckpointError(
            f"{where}: expected a 'registry_name' or a 'class', found neither. {FETCH_AGAIN}"
        )
    state_file = get_text(step, "state_file", where=where)
    return SavedStep(
        registry_name=registry_name or None,
        imported=imported,
        config=get_mapping(step, "config", where=where),
        state_file=None if state_file is None else _state_file(path.parent, state_file, where=where),
        where=where,
    )


def refuse_built_in_normalization(folder: Path) -> None:
    """Raise `CheckpointError` for weights that hold their normalisation, as before LeRobot's processors."""
    file = folder / WEIGHTS_FILE
    if not file.is_file():
        return
    try:
        with safe_open(file, framework="np") as header:
            names = list(header.keys())
    except Exception as exc:  # safetensors raises a class of its own that is not public
        raise unreadable(file, exc) from exc
    built_in = [name for name in names if name.startswith(BUILT_IN) and name.endswith(BUILT_IN_STATISTICS)]
    if built_in:
        raise CheckpointError(
            f"{file}: the statistics of normalisation are among the weights ({shown(built_in[0])}): the "
            f"checkpoint is of a LeRobot before its processors ({PREPROCESSOR_FILE}, {POSTPROCESSOR_FILE}). "
            f"Migrate it with LeRobot's command, and use the folder NEW: {MIGRATE} --pretrained-path "
            f"{shlex.quote(str(folder))} --output-dir NEW"
        )


def _missing(path: Path) -> CheckpointError:
    """Return the error of a file of a processor that is not there."""
    return CheckpointError(
        f"{path}: there is no such file, by which the policy's inputs or actions are normalised. A training "
        f"(`mikasa-vla finetune`, lerobot-train) writes it beside the weights: copy all files of its folder "
        f"pretrained_model, or fetch the whole repository again (`hf download`), not {CONFIG_FILE} and "
        f"{WEIGHTS_FILE} alone."
    )


def _state_file(folder: Path, name: str, *, where: str) -> Path:
    if not name.endswith(STATE_SUFFIX) or Path(name).is_absolute() or leads_out(name, folder):
        raise CheckpointError(
            f"{where}: 'state_file': expected a {STATE_SUFFIX} file inside of {folder}, found {shown(name)}. "
            "It is not read."
        )
    if not (folder / name).exists():
        raise _missing(folder / name)
    return folder / name


def check_paths(step: SavedStep, config: Mapping[str, Any], folder: Path) -> None:
    """Raise `CheckpointError` for settings of a step that are paths out of the checkpoint's folder."""
    for key, value in _texts(config):
        if leads_out(value, folder):
            raise CheckpointError(
                f"{step.where}: {step.name!r:.100} is to be given {key:.100} = {shown(value)}, a path "
                f"outside of the checkpoint. A step may only read {folder}. Put what it needs there; a "
                "tokenizer's folder can be named with `tokenizer` in the recipe's args."
            )


def leads_out(value: str, folder: Path) -> bool:
    """Whether a text leads out of a folder as a path, by itself or by a link; a name of the Hub does not."""
    if "\0" in value or value.startswith("~") or ".." in Path(value).parts:
        return True
    place = Path(os.path.realpath(folder / value))  # unlike Path.resolve, of a loop of links, too
    return not place.is_relative_to(_root(Path(os.path.realpath(folder))))


def _root(folder: Path) -> Path:
    """Return what belongs to a checkpoint: its folder, or its repository in the Hub's cache of links."""
    for parent in (folder, *folder.parents):
        if parent.parent.name == HUB_SNAPSHOTS and (parent.parent.parent / HUB_BLOBS).is_dir():
            return parent.parent.parent
    return folder


def _texts(data: object, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield all texts of plain data with where they stand; keys of mappings, too."""
    if isinstance(data, str):
        yield key, data
    elif isinstance(data, Mapping):
        for name, value in data.items():
            yield from _texts(value, f"{key}.{name}" if key else str(name))
            yield f"a key of {key or 'config'}", str(name)
    elif isinstance(data, list):
        for item in data:
            yield from _texts(item, key)
