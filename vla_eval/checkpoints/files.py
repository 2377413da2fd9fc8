"""LeRobot checkpoints as files: find them, hash them, and read what they were trained on.

Standard library only: planning an evaluation must not wait for torch. Knows nothing of models.
"""

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vla_eval.checkpoints.bases import how_to_get, hub_folder
from vla_eval.config.files import search_folders
from vla_eval.errors import CheckpointError, RecipeError, did_you_mean
from vla_eval.lock.switch import distrust
from vla_eval.seeding import SeedRange
from vla_eval.storage.folders import what_is
from vla_eval.strict.decoding import decode
from vla_eval.strict.json_fields import FETCH_AGAIN, get_text
from vla_eval.strict.json_fields import read_json as read_json  # where most look for it

CONFIG_FILE = "config.json"
WEIGHTS_FILE = "model.safetensors"
ADAPTER_WEIGHTS_FILE = "adapter_model.safetensors"
ADAPTER_CONFIG_FILE = "adapter_config.json"
PREPROCESSOR_FILE, POSTPROCESSOR_FILE = "policy_preprocessor.json", "policy_postprocessor.json"
TOKENIZER_FOLDER, ACTION_TOKENIZER_FOLDER = "tokenizer", "action_tokenizer"
VLM_FOLDER = "vlm"  # configuration and processor of SmolVLA's language model, without weights
FACTS_FILE = "mikasa_training.json"
BASE_FILE = "mikasa_base.json"  # where a base that was fetched came from
MODEL_FOLDER = "pretrained_model"
# Where a checkpoint may lie below the folder that was named, and those of a run: lerobot's, then ours.
INSIDE = (Path(), Path(MODEL_FOLDER))
RUNS = (Path("checkpoints"), Path("train/checkpoints"))
LAST = "last"
SHIPPED_FOLDER = "checkpoints"
FACTS_VERSION = 1
"""Of `mikasa_training.json`. Raise it when a field changes its meaning."""
# How the model was trained does not change what it is; the rest is for people.
NOT_HASHED = frozenset({"train_config.json", "README.md", ".gitattributes", BASE_FILE})


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingFacts:
    """What a policy saw in training, kept beside its weights and compared before an evaluation."""

    run: str
    dataset: str
    dataset_sha256: str  # of its content
    task: str  # empty if the demonstrations are of several tasks, or of none that is known
    state: str  # which proprioception `observation.state` was: `eef` or `joints`
    images: dict[str, tuple[int, ...]]  # field, in the policy's order -> (height_px, width_px)
    fps: float
    action_names: tuple[str, ...]
    control_mode: str
    run_seed: int
    # by task; None: not known (another program's seed is another episode) or, by earlier versions, not noted
    seeds: dict[str, tuple[SeedRange, ...]] | None = None
    tasks: tuple[str, ...] = ()  # all of them; empty where they are not known
    # by task, empty if not known; None: not noted, as by earlier versions
    sentences: dict[str, tuple[str, ...]] | None = None
    gripper_open: float | None = None  # the gripper's number that opens it; None: not noted
    robot: str | None = None  # None: not noted, or a robot that is not one of ours


def find_checkpoint(path: Path) -> Path:
    """Return the folder with the weights, of a checkpoint, a run, or a name in a folder `checkpoints/`.

    Of a Hub id, `hub:OWNER/NAME`, it is the folder that it was fetched to.
    """
    asked, path = path, hub_folder(str(path)) or path
    places = [path]
    if path.name == str(path):
        places += [folder / path for folder in search_folders(SHIPPED_FOLDER)]
    for folder in (folder for place in places for folder in _may_be_in(place)):
        # os.path, unlike Path, says no to what cannot be a path at all: too long, or with a NUL.
        if os.path.isfile(folder / CONFIG_FILE) and weights_file(folder) is not None:
            distrust(path if os.path.isdir(path) else folder)
            return folder
    if not os.path.isdir(path):
        found = "no such folder"
    else:
        names = sorted(entry.name for entry in path.iterdir())
        found = ", ".join(names[:8]) or "an empty folder"
    command = how_to_get(asked)
    hint = command or did_you_mean(str(path), list_checkpoints())
    raise CheckpointError(
        f"{asked!s:.300}: expected a LeRobot checkpoint ({CONFIG_FILE} and {WEIGHTS_FILE}), or a run folder "
        f"that holds checkpoints/last/{MODEL_FOLDER}; found {found}.{what_is(path)} Weights in other formats "
        f"(.bin, .pt) are never loaded: convert them to safetensors.{hint}"
    )


def _may_be_in(place: Path) -> Iterator[Path]:
    """Yield the folders of a place that may hold a checkpoint; of a run the newest comes first.

    `last` is followed where it is a link. A copy of a run may have a folder of that name, or none: then the
    highest step is the newest.
    """
    yield from (place / inside for inside in INSIDE)
    for checkpoints in (place / run for run in RUNS):
        last = checkpoints / LAST
        steps = step_folders(checkpoints)[::-1] if os.path.isdir(checkpoints) else []
        in_order = (last, *steps) if os.path.islink(last) else (*steps, last)
        yield from (folder / MODEL_FOLDER for folder in in_order)


def step_folders(checkpoints: Path) -> list[Path]:
    """Return the folders of steps (`000100`), in the order of their steps."""
    found = [entry for entry in checkpoints.glob("[0-9]*") if entry.name.isascii() and entry.name.isdigit()]
    return sorted(found, key=lambda entry: int(entry.name))


def list_checkpoints() -> list[str]:
    """Return the names in `checkpoints/`, the user's and the package's."""
    entries = [entry for folder in search_folders(SHIPPED_FOLDER) for entry in folder.glob("*/")]
    return sorted({entry.name for entry in entries if not entry.name.startswith(".")})


def weights_file(folder: Path) -> Path | None:
    """Return the file of the weights, or of the adapter's weights, if there is one."""
    for name in (ADAPTER_WEIGHTS_FILE, WEIGHTS_FILE):
        if (folder / name).is_file():
            return folder / name
    return None


def checkpoint_name(path: Path) -> str:
    """Return a name for records and tables: the run's name and the step of the checkpoint."""
    folder = find_checkpoint(path).resolve()
    parts = [part for part in folder.parts if part not in (MODEL_FOLDER, "checkpoints", "train", "/")]
    named = parts[-2:] if parts and parts[-1].isdigit() else parts[-1:]
    name = re.sub(r"[^A-Za-z0-9._-]", "_", "-".join(named))
    return name.lstrip("-.") or "checkpoint"  # a spreadsheet takes -x for a formula


def checkpoint_sha256(path: Path) -> str:
    """Return a digest of all files that the policy's actions depend on, the base of an adapter included."""
    folder = find_checkpoint(path)
    below: str | None = None
    for part in reversed([folder, *adapter_bases(folder)]):
        digest = hashlib.sha256()
        for file in sorted(part.rglob("*")):
            name = file.relative_to(part).as_posix()
            if file.is_file() and name not in NOT_HASHED:
                digest.update(f"{name}\0{file_sha256(file)}\n".encode())
        if below is not None:
            digest.update(f"base\0{below}\n".encode())
        below = digest.hexdigest()
    assert below is not None  # there is at least the folder itself
    return below


def adapter_base(folder: Path) -> Path | None:
    """Return where the checkpoint that a LoRA adapter was trained on lies; None for a whole model."""
    file = folder / ADAPTER_CONFIG_FILE
    if not file.is_file():
        return None
    base = get_text(read_json(file), "base_model_name_or_path", where=str(file))
    return Path(base) if base else None


def adapter_bases(folder: Path, *, base_checkpoint: str | None = None) -> list[Path]:
    """Return the checkpoints below a LoRA adapter that are there, nearest first; none for a whole model.

    `base_checkpoint`: where its base lies; None: where it was in training. None may be its own base.
    """
    if not (folder / ADAPTER_CONFIG_FILE).is_file():
        return []
    chain = [folder]
    base = Path(base_checkpoint) if base_checkpoint else adapter_base(folder)
    while base is not None and base.is_dir():
        found = find_checkpoint(base)
        if found.resolve() in [part.resolve() for part in chain]:
            raise CheckpointError(
                f"{chain[-1] / ADAPTER_CONFIG_FILE}: expected the base of the adapter, found {found}, which "
                "is the adapter itself or stands on it. Name the base's folder with `base_checkpoint` in "
                "the recipe's args."
            )
        chain.append(found)
        base = adapter_base(found)
    return chain[1:]


def write_facts(folder: Path, facts: TrainingFacts) -> None:
    """Write what the policy saw in training beside its weights."""
    data = {"format_version": FACTS_VERSION, **dataclasses.asdict(facts)}
    (folder / FACTS_FILE).write_text(f"{json.dumps(data, indent=2)}\n", encoding="utf-8")


def read_facts(folder: Path) -> TrainingFacts | None:
    """Return what the policy saw in training; None for a checkpoint that another program made."""
    path = folder / FACTS_FILE
    if not path.is_file():
        return None
    data = read_json(path)
    version = data.pop("format_version", None)
    if version != FACTS_VERSION:
        raise CheckpointError(
            f"{path}: format version {version}, this program reads version {FACTS_VERSION}. Use the version "
            f"of mikasa-vla-eval that wrote it."
        )
    try:
        return decode(TrainingFacts, data, where=str(path))
    except RecipeError as exc:
        raise CheckpointError(f"{exc} The file was changed; fetch the checkpoint again.") from exc


def unreadable(file: Path, exc: Exception) -> CheckpointError:
    """Return the error of a file that is not safetensors, whose library raises a class that is not public."""
    return CheckpointError(f"{file}: cannot be read as safetensors ({exc}). {FETCH_AGAIN}")


def file_sha256(path: Path) -> str:
    """Return the sha256 of one file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
