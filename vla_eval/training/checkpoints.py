"""Checkpoints in lerobot's form: each is written atomically, and a damaged one gives an error message."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any  # lerobot and accelerate are untyped

from accelerate.utils import DistributedType
from lerobot.common import train_utils
from torch import nn

from vla_eval.checkpoints.files import LAST, MODEL_FOLDER, write_facts
from vla_eval.checkpoints.processors import save_tokenizers, save_vlm_files
from vla_eval.errors import TrainingError
from vla_eval.storage.durable import sync_tree
from vla_eval.strict.json_text import Source, read_file, read_json, shown
from vla_eval.training.job import TrainingJob
from vla_eval.training.run_folder import PARTIAL_PREFIX, STATE_FOLDER, point

LOSS_SCALE_FILE = "loss_scale.json"


def write_checkpoint(
    job: TrainingJob, step: int, accelerator: Any, parts: dict[str, Any], scaler: Any
) -> Path | None:
    """Write the checkpoint of a step, with all processes; return its folder in the first one."""
    if accelerator.distributed_type == DistributedType.FSDP:  # each process has a share of the weights
        gathered = train_utils.gather_fsdp_state_dicts(parts["policy"], parts["optimizer"])
        parts["model_state_dict"], parts["optim_state_dict"] = gathered
    if not accelerator.is_main_process:
        return None
    folder: Path = train_utils.get_step_checkpoint_dir(parts["cfg"].output_dir, job.recipe.steps, step)
    partial = folder.with_name(f"{PARTIAL_PREFIX}{folder.name}")
    parts["policy"] = accelerator.unwrap_model(parts["policy"])
    with _recurrent_weights_apart(parts["policy"]):
        train_utils.save_checkpoint(
            checkpoint_dir=partial,
            step=step,
            num_processes=accelerator.num_processes,
            batch_size=job.recipe.batch_size,
            **parts,
        )
    if scaler.is_enabled():
        (partial / STATE_FOLDER / LOSS_SCALE_FILE).write_text(f"{json.dumps(scaler.state_dict())}\n")
    write_facts(partial / MODEL_FOLDER, job.facts)
    save_tokenizers(parts["preprocessor"], partial / MODEL_FOLDER)
    save_vlm_files(job.policy, partial / MODEL_FOLDER)
    sync_tree(partial)
    os.replace(partial, folder)
    point(folder.parent / LAST, folder.name)
    return folder


@contextlib.contextmanager
def _recurrent_weights_apart(policy: nn.Module) -> Iterator[None]:
    """Let each weight of a GRU or LSTM have a storage of its own: cuDNN's is one, for all."""

    def copied(module: nn.Module, state: dict[str, Any], prefix: str, metadata: Any) -> None:
        for name, _ in module.named_parameters():
            state[prefix + name] = state[prefix + name].clone()

    recurrent = [module for module in policy.modules() if isinstance(module, nn.RNNBase)]
    hooks = [
        module.register_state_dict_post_hook(copied)  # type: ignore[no-untyped-call]
        for module in recurrent
    ]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def load_state(folder: Path, optimizer: Any, scheduler: Any, *, load_optimizer: bool) -> None:
    """Load the state of a training, which is safetensors and JSON, and that of the random generators."""
    try:
        train_utils.load_training_state(folder, optimizer, scheduler, load_optimizer=load_optimizer)
    except Exception as exc:  # lerobot, torch and safetensors raise what they like
        raise TrainingError(
            f"{folder}: the state of the training cannot be read ({exc!r:.300}). Remove this checkpoint's "
            "folder to resume from the one before it, or use another --out."
        ) from exc


def load_loss_scale(folder: Path, scaler: Any) -> None:
    """Load the scale of the loss: from another one, other steps would be left out because of an overflow."""
    if not scaler.is_enabled():
        return
    file = folder / STATE_FOLDER / LOSS_SCALE_FILE
    if not file.is_file():
        raise TrainingError(
            f"{file}: is missing. A training in float16 resumes with the scale of its loss; this checkpoint "
            "was written before there was this file, or in another precision. Use another --out."
        )
    source = Source(
        where=str(file), what="the scale of a loss", remedy="Use another --out.", error=TrainingError
    )
    data = read_json(read_file(file, source), source)
    fields = scaler.state_dict()
    if data.keys() != fields.keys() or any(type(data[name]) is not type(fields[name]) for name in fields):
        kinds = ", ".join(f"{name} ({type(value).__name__})" for name, value in fields.items())
        raise source.refuse(shown(data), f"its fields are {kinds}")
    scaler.load_state_dict(data)
