"""Check a LeRobot checkpoint by using it: weights, statistics, and one chunk of finite actions."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch
from torch import Tensor

from vla_eval.checkpoints.files import WEIGHTS_FILE, checkpoint_sha256, weights_file
from vla_eval.checkpoints.loading import (
    LoadedPolicy,
    LoadOptions,
    load_checkpoint,
    make_unfilled_policy,
    read_config,
)
from vla_eval.checkpoints.policy_types import asked_for_steps, chunk_size, history, noise_shape
from vla_eval.errors import CheckpointError, InvalidActionError
from vla_eval.models.episodes.memory import remembers_singly
from vla_eval.models.episodes.running import select_step
from vla_eval.models.shared.earlier_frames import mask_field
from vla_eval.models.weights.exact import check_fit
from vla_eval.models.weights.file import WeightFile

INSTRUCTION = "pick the cube"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verified:
    """What was found; `statistics` are `field.statistic`, `chunk` is the shape of one pass's actions."""

    folder: Path
    kind: str
    n_tensors: int
    n_parameters: int
    n_trained: int
    statistics: tuple[str, ...]
    chunk: tuple[int, ...]
    sha256: str

    def lines(self, *, verbose: bool = False) -> list[str]:
        """Return lines for a person; `verbose`: with the name of each statistic."""
        fields = dict.fromkeys(name.rpartition(".")[0] for name in self.statistics)
        statistics = f"{len(self.statistics)} of {', '.join(fields)}" if fields else ""
        if verbose:
            statistics = ", ".join(self.statistics)
        return [
            f"checkpoint   {self.folder} ({self.sha256[:12]})",
            f"type         {self.kind}",
            f"weights      {self.n_tensors} tensors, none missing, none left over, all finite",
            f"parameters   {self.n_parameters:,}, of which {self.n_trained:,} are trained",
            f"statistics   {statistics or 'none needed'}",
            f"forward pass {' × '.join(map(str, self.chunk))} actions, all finite",
        ]


def check_structure(folder: Path) -> str:
    """Compare names and shapes of a whole model's weights, unread, with the network; return a line."""
    config = read_config(folder, LoadOptions(device="cpu"))
    policy = make_unfilled_policy(config, where=folder)
    file = folder / WEIGHTS_FILE
    weights = WeightFile(file)
    check_fit(policy, weights, where=str(file), cast=True)
    n_parameters = sum(x.numel() for x in policy.parameters())
    return (
        f"{config.type}, {len(weights)} tensors with the names and shapes of the network, none missing, "
        f"none left over; {n_parameters:,} parameters"
    )


def verify_checkpoint(path: Path, options: LoadOptions) -> Verified:
    """Load a checkpoint strictly and let it act once on random images; actions have to be finite."""
    loaded = load_checkpoint(path, options)
    with loaded.acting():
        actions = _act(loaded)
        expected = (1, chunk_size(loaded.config), int(loaded.config.action_feature.shape[0]))
    if tuple(actions.shape) != expected or not torch.isfinite(actions).all():
        raise InvalidActionError(
            f"{loaded.folder}: expected finite actions of shape {expected}, found {tuple(actions.shape)}, "
            f"finite: {bool(torch.isfinite(actions).all())}."
        )
    file = weights_file(loaded.folder)
    assert file is not None  # it was just loaded
    parameters = list(loaded.policy.parameters())
    return Verified(
        folder=loaded.folder,
        kind=loaded.config.type,
        n_tensors=len(WeightFile(file)),
        n_parameters=sum(x.numel() for x in parameters),
        n_trained=sum(x.numel() for x in parameters if x.requires_grad),
        statistics=_used_statistics(loaded),
        chunk=expected,
        sha256=checkpoint_sha256(loaded.folder),
    )


@torch.no_grad()
def _act(loaded: LoadedPolicy) -> Tensor:
    config, draws = loaded.config, torch.Generator().manual_seed(0)
    extra: dict[str, Any] = {}
    shape = noise_shape(config)
    if shape is not None:
        extra["noise"] = torch.randn(1, *shape, generator=draws).to(config.device)
    if callable(getattr(loaded.policy, "remember", None)):
        times = () if remembers_singly(loaded.policy) else (0,)
        extra["memory"] = loaded.policy.remember(
            loaded.preprocessor(random_batch(config, times, draws)), None
        )
    loaded.policy.reset()
    batch = loaded.preprocessor(random_batch(config, history(config), draws))
    if asked_for_steps(config.type):
        raw = select_step(loaded.policy, batch, None).action
    else:
        raw = loaded.policy.predict_action_chunk(batch, **extra)
    actions: Tensor = loaded.postprocessor(raw)
    return actions


def random_batch(config: Any, deltas: tuple[int, ...], draws: torch.Generator) -> dict[str, Any]:
    """Return random fields of one episode, (1, …), or with frames in time (1, T, …)."""
    batch: dict[str, Any] = {"task": [INSTRUCTION]}
    times = (len(deltas),) if deltas else ()
    for key, feature in config.input_features.items():
        if not key.startswith("observation."):
            raise CheckpointError(f"the field '{key}' is not an observation; nothing can be made up for it.")
        batch[key] = torch.rand(1, *times, *feature.shape, generator=draws)
        if times:
            batch[f"{key}_is_pad"] = torch.zeros(1, *times, dtype=torch.bool)
        if key in getattr(config, "memory_fields", ()):
            batch[mask_field(key)] = torch.ones(1, *times, dtype=torch.bool)
    return batch


def _used_statistics(loaded: LoadedPolicy) -> tuple[str, ...]:
    found: dict[str, None] = {}
    for step in (*loaded.preprocessor.steps, *loaded.postprocessor.steps):
        for key, values in (getattr(step, "stats", None) or {}).items():
            found.update(dict.fromkeys(f"{key}.{name}" for name in values))
    return tuple(found)
