"""Checkpoints of an agent's training: the network, its optimizers, the buffer of earlier steps, what counts.

Safetensors, JSON and npz; the library's own archive, which holds pickles, is neither written nor read.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # the library's models, and torch's states

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from vla_eval.agents.job import AgentJob
from vla_eval.checkpoints.files import LAST, MODEL_FOLDER, WEIGHTS_FILE
from vla_eval.errors import TrainingError
from vla_eval.policies.agents.network import AgentNetwork, save_network, shapes_of
from vla_eval.storage.durable import sync_tree
from vla_eval.strict.json_text import Source, read_file, read_json, shown
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.training.run_folder import CHECKPOINTS_FOLDER, PARTIAL_PREFIX, STATE_FOLDER, TRAIN_FOLDER, point

NETWORK = "policy"  # the library's name of its network among what it saves
OPTIMIZER_FILE, COUNTS_FILE, BUFFER_FILE = "optimizer.safetensors", "counts.json", "buffer.npz"
COUNTS = ("num_timesteps", "_n_updates", "_episode_num")
"""Attributes of the library's models that say how far they are."""
BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
STEP_DIGITS = 9


def checkpoint_folder(job: AgentJob, step: int) -> Path:
    """Return the folder of the checkpoint of a step."""
    return job.out / TRAIN_FOLDER / CHECKPOINTS_FOLDER / f"{step:0{STEP_DIGITS}d}"


def write_checkpoint(job: AgentJob, model: Any) -> Path:
    """Write the checkpoint of the step that the model is at: all of it, or nothing."""
    folder = checkpoint_folder(job, model.num_timesteps)
    partial = folder.with_name(f"{PARTIAL_PREFIX}{folder.name}")
    saved, loose = _parts(model)
    save_network(partial / MODEL_FOLDER, _about(job, model), saved.pop(NETWORK))
    state = partial / STATE_FOLDER
    state.mkdir()
    tensors, plain = _flat({**saved, "variables": loose})
    save_file(tensors, state / OPTIMIZER_FILE)
    counts = {name: getattr(model, name) for name in COUNTS}
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        counts |= {"buffer_position": buffer.pos, "buffer_full": buffer.full}
        np.savez(state / BUFFER_FILE, allow_pickle=False, **_buffer_arrays(buffer))
    (state / COUNTS_FILE).write_text(f"{json.dumps({'counts': counts, 'plain': plain})}\n", encoding="utf-8")
    sync_tree(partial)
    os.replace(partial, folder)
    point(folder.parent / LAST, folder.name)
    return folder


def load_checkpoint(folder: Path, model: Any) -> None:
    """Bring a model that was just made to where it was when the checkpoint was written.

    Raises:
        TrainingError: a file is damaged, or not of this training.
    """
    state = folder / STATE_FOLDER
    source = _source(state / COUNTS_FILE)
    data = read_json(read_file(state / COUNTS_FILE, source), source)
    counts, plain = data.get("counts"), data.get("plain")
    if not isinstance(counts, dict) or not isinstance(plain, dict) or type(counts.get(COUNTS[0])) is not int:
        raise source.refuse(shown(data), f"expected counts, {COUNTS[0]} among them, and plain values")
    try:
        tensors = load_file(state / OPTIMIZER_FILE, device=str(model.device))
        weights = load_file(folder / MODEL_FOLDER / WEIGHTS_FILE, device=str(model.device))
        found = _nested(tensors, plain)
        loose = found.pop("variables", {})
        model.set_parameters({NETWORK: weights, **found}, exact_match=True, device=model.device)
        for name, value in loose.items():
            getattr(model, name).data.copy_(value)
        for name in COUNTS:
            setattr(model, name, counts[name])
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            _fill(buffer, state / BUFFER_FILE, counts)
    except (SafetensorError, OSError, KeyError, ValueError, RuntimeError, AttributeError, EOFError) as exc:
        raise TrainingError(
            f"{folder}: the state of the training cannot be read ({' '.join(str(exc).split()):.300}). Remove "
            "this checkpoint's folder to resume from the one before it, or use another --out."
        ) from exc


def _about(job: AgentJob, model: Any) -> AgentNetwork:
    return AgentNetwork(
        algorithm=job.recipe.algorithm,
        observation=job.reader.mode,
        task=job.task,
        env=without_path(job.settings.kwargs),
        shapes=shapes_of(model.observation_space),
        action_dims=job.env.action.dims,
        control_mode=job.env.action.control_mode,
        network=dict(job.recipe.network),
    )


def _parts(model: Any) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the states of network and optimizers, and the tensors that belong to neither."""
    _, names = model._get_torch_save_params()  # there is no public name
    return dict(model.get_parameters()), {name: getattr(model, name) for name in names}


def _flat(nested: Mapping[str, Any]) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Return the tensors of nested mappings and lists by their paths, and what else is there likewise."""
    tensors: dict[str, torch.Tensor] = {}
    plain: dict[str, Any] = {}

    def walk(value: Any, path: str) -> None:
        if isinstance(value, torch.Tensor):
            tensors[path] = value.detach().cpu().clone().contiguous()
        elif isinstance(value, Mapping) and value:
            for key, inner in value.items():
                walk(inner, f"{path}/{'#' if isinstance(key, int) else ''}{key}" if path else str(key))
        else:
            plain[path] = value

    walk(nested, "")
    return tensors, plain


def _nested(tensors: Mapping[str, torch.Tensor], plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `_flat` was given."""
    found: dict[str, Any] = {}
    for path, value in {**plain, **tensors}.items():
        *inner, last = [int(part[1:]) if part.startswith("#") else part for part in path.split("/")]
        place: dict[Any, Any] = found
        for part in inner:
            place = place.setdefault(part, {})
        place[last] = tuple(value) if last == "betas" else value
    return found


def _buffer_arrays(buffer: Any) -> dict[str, np.ndarray[Any, Any]]:
    """Return the filled part of a buffer of earlier steps, by name; `observations/vector` of a mapping."""
    end = buffer.buffer_size if buffer.full else buffer.pos
    found = {}
    for name in BUFFER_ARRAYS:
        values = getattr(buffer, name)
        for key, part in values.items() if isinstance(values, dict) else [("", values)]:
            found[f"{name}/{key}" if key else name] = part[:end]
    return found


def _fill(buffer: Any, file: Path, counts: Mapping[str, Any]) -> None:
    expected = _buffer_arrays(buffer).keys()
    with np.load(file, allow_pickle=False) as arrays:
        if set(arrays) != set(expected):
            raise ValueError(f"{file.name}: expected {sorted(expected)}, found {sorted(arrays)}")
        for path in arrays:
            name, _, key = path.partition("/")
            values = getattr(buffer, name)
            values = values[key] if key else values
            stored = arrays[path]
            values[: len(stored)] = stored
    buffer.pos, buffer.full = int(counts["buffer_position"]), bool(counts["buffer_full"])


def _source(where: Path) -> Source:
    remedy = "Remove this checkpoint's folder to resume from the one before it, or use another --out."
    return Source(where=str(where), what="the counts of a training", remedy=remedy, error=TrainingError)
