"""Make a LeRobot checkpoint of a published one, by its family's converter; a whole folder or none."""

import json
import shutil
from pathlib import Path
from typing import Any  # a family's options

from safetensors.torch import save_file

from vla_eval.checkpoints.files import (
    ADAPTER_CONFIG_FILE,
    ADAPTER_WEIGHTS_FILE,
    CONFIG_FILE,
    TOKENIZER_FOLDER,
    WEIGHTS_FILE,
    find_checkpoint,
    read_json,
)
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import LoadOptions, load_weights, make_unfilled_policy, read_config
from vla_eval.checkpoints.processors import save_tokenizers
from vla_eval.errors import CheckpointError
from vla_eval.models.families import FAMILIES, family_of_base
from vla_eval.models.family import Base, imported
from vla_eval.models.shared.options import typed
from vla_eval.models.shared.original import Original
from vla_eval.models.weights.exact import put_weights
from vla_eval.storage.drafts import whole_folder

TOKENIZER_FILES = ("tokenizer*", "special_tokens_map.json", "added_tokens.json")


def convert(kind: str, source: Path, out: Path, options: Any) -> Path:
    """Write the LeRobot checkpoint `out` with every parameter of the original and no other; return it."""
    check_free(out)
    original: Original = imported(FAMILIES[kind].converter)(source, options)
    policy = make_unfilled_policy(original.config)
    put_weights(policy, original.weights(policy), where=str(source), cast=original.casts)
    with whole_folder(out, error=CheckpointError) as partial:
        partial.mkdir(parents=True)
        _save(original, policy, source, partial, out)
    return out


def convert_base(base: Base, source: Path, out: Path) -> Path:
    """Convert a published base as recipes expect it, with the options that its row states; see `convert`."""
    family = family_of_base(base)
    return convert(family.type, source, out, imported(family.convert_options)(**_options(base, source)))


def convert_command(base: Base, source: Path, out: Path) -> str:
    """Return the command that does what `convert_base` does."""
    family = family_of_base(base)
    words = typed(imported(family.convert_options), _options(base, source))
    return " ".join(
        ["mikasa-vla checkpoint", f"convert-{family.name}", str(source), *words, "--out", str(out)]
    )


def _options(base: Base, source: Path) -> dict[str, Any]:
    return {
        name: value.format(source=source) if isinstance(value, str) else value
        for name, value in (base.options or {}).items()
    }


def _save(original: Original, policy: Any, source: Path, partial: Path, out: Path) -> None:
    is_beside = original.check_tokenizer is not None
    if is_beside:
        policy.config.tokenizer_name = str(_copy_tokenizer(source, partial / TOKENIZER_FOLDER))
    with no_foreign_code(policy.config.type):
        processors = original.make_processors()
    if original.check_tokenizer is not None:
        steps = (step for step in processors[0].steps if hasattr(step, "input_tokenizer"))
        original.check_tokenizer(next(steps).input_tokenizer)
        policy.config.tokenizer_name = str(out / TOKENIZER_FOLDER)
    else:
        save_tokenizers(processors[0], partial)
    policy.save_pretrained(partial)
    for processor in processors:
        processor.save_pretrained(partial)


def check_free(out: Path) -> None:
    """Raise `CheckpointError` for a folder that is there."""
    if out.exists():
        raise CheckpointError(f"{out} exists already. Name another folder.")


def _copy_tokenizer(source: Path, folder: Path) -> Path:
    files = [file for pattern in TOKENIZER_FILES for file in sorted(source.glob(pattern)) if file.is_file()]
    if not files:
        raise CheckpointError(f"{source}: expected the tokenizer's files, found none. Fetch them, too.")
    folder.mkdir(parents=True)
    for file in files:
        shutil.copy2(file, folder / file.name)
    return folder


NOT_COPIED = (ADAPTER_CONFIG_FILE, ADAPTER_WEIGHTS_FILE, "README.md", "train_config.json")


def merge_adapter(path: Path, out: Path, *, base_checkpoint: str | None = None) -> Path:
    """Write a checkpoint `out` whose weights are base plus adapter, in the base's precision; return it."""
    folder = find_checkpoint(path)
    if not (folder / ADAPTER_CONFIG_FILE).is_file():
        raise CheckpointError(f"{folder}: expected a LoRA adapter, found no LoRA adapter but a whole model.")
    check_free(out)
    options = LoadOptions(device="cpu", base_checkpoint=base_checkpoint)
    config = read_config(folder, options)
    merged = load_weights(folder, config, options).merge_and_unload()
    described = {**read_json(folder / CONFIG_FILE), "use_peft": False, "pretrained_path": None}
    weights = {name: tensor.cpu().contiguous() for name, tensor in merged.state_dict().items()}
    with whole_folder(out, error=CheckpointError) as partial:
        partial.mkdir(parents=True)
        shutil.copytree(folder, partial, ignore=shutil.ignore_patterns(*NOT_COPIED), dirs_exist_ok=True)
        (partial / CONFIG_FILE).write_text(f"{json.dumps(described, indent=4)}\n", encoding="utf-8")
        save_file(weights, partial / WEIGHTS_FILE)
    return out
