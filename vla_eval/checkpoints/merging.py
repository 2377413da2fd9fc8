"""Merge a LoRA adapter into its base: one whole checkpoint, which needs neither peft nor the base."""

import json
import shutil
from pathlib import Path

from safetensors.torch import save_file

from vla_eval.checkpoints.conversion import check_free, folder_when_whole
from vla_eval.checkpoints.files import (
    ADAPTER_CONFIG_FILE,
    ADAPTER_WEIGHTS_FILE,
    CONFIG_FILE,
    WEIGHTS_FILE,
    find_checkpoint,
    read_json,
)
from vla_eval.checkpoints.loading import LoadOptions, load_weights, read_config
from vla_eval.errors import CheckpointError

NOT_COPIED = (ADAPTER_CONFIG_FILE, ADAPTER_WEIGHTS_FILE, "README.md", "train_config.json")


def merge_adapter(path: Path, out: Path, *, base_checkpoint: str | None = None, device: str = "cpu") -> Path:
    """Write a checkpoint `out` whose weights are base plus adapter; return it.

    Sums are made in the precision of the base: in bfloat16 the actions differ by its rounding. Without
    `base_checkpoint`, the base is where it was in training.
    """
    folder = find_checkpoint(path)
    if not (folder / ADAPTER_CONFIG_FILE).is_file():
        raise CheckpointError(f"{folder}: expected a LoRA adapter, found no LoRA adapter but a whole model.")
    check_free(out)
    options = LoadOptions(device=device, base_checkpoint=base_checkpoint)
    config = read_config(folder, options)
    merged = load_weights(folder, config, options).merge_and_unload()
    described = {**read_json(folder / CONFIG_FILE), "use_peft": False, "pretrained_path": None}
    weights = {name: tensor.cpu().contiguous() for name, tensor in merged.state_dict().items()}
    with folder_when_whole(out) as partial:
        shutil.copytree(folder, partial, ignore=shutil.ignore_patterns(*NOT_COPIED), dirs_exist_ok=True)
        (partial / CONFIG_FILE).write_text(f"{json.dumps(described, indent=4)}\n", encoding="utf-8")
        save_file(weights, partial / WEIGHTS_FILE)
    return out
