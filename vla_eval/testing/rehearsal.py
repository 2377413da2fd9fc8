"""Rehearse a recipe at its true size with random weights, or a checkpoint: write, load it strictly, act.

What is measured is memory, disk and time; the actions mean nothing. Weights are made part by part, so that
they are in memory once, when they are loaded.
"""

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any  # lerobot is untyped

import torch

from vla_eval.checkpoints.files import ADAPTER_CONFIG_FILE, WEIGHTS_FILE, find_checkpoint
from vla_eval.checkpoints.loading import LoadOptions, make_unfilled_policy, read_config
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow, Policy
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError
from vla_eval.features import CAMERA_KEYS
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing.inference_rates import inference_rates
from vla_eval.testing.process_memory import peak_device_bytes, peak_rss_bytes, reset_device_peak, reset_peak
from vla_eval.testing.random_checkpoint import PART, TASK, built_tiny, stand_in_config, write_checkpoint
from vla_eval.testing.rehearsed import Estimated, Rehearsed, limit_bytes
from vla_eval.training.cost.estimate import describe_model, unfilled_model, with_adapters
from vla_eval.training.cost.sample_cost import sample_cost
from vla_eval.training.request import load_finetune_recipe
from vla_eval.workers.start import available_ram_bytes

N_STEPS = 20
GB = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class RehearsalOptions:
    """How to rehearse: the folder is removed afterwards, `dtype` None is the recipe's or as saved."""

    folder: Path
    dtype: str | None = None
    device: str = "cpu"
    tiny: bool = False


def rehearse(name: str, options: RehearsalOptions, *, batches: Sequence[int] = ()) -> Rehearsed:
    """Rehearse a recipe with something to train, and time passes of `batches` episodes; its folder is new."""
    if options.folder.exists():
        raise CheckpointError(f"{options.folder} exists already. Name another folder with --out.")
    recipe = load_finetune_recipe(FinetuneConfig(policy=name, dataset="none")).value
    reset_peak()  # of what this process rehearsed before
    before = peak_rss_bytes()
    options.folder.mkdir(parents=True)
    try:
        with built_tiny(recipe.type, tiny=options.tiny):
            return _rehearse(name, recipe, options, before, batches)
    finally:
        shutil.rmtree(options.folder)


def rehearse_checkpoint(path: Path, options: RehearsalOptions) -> Rehearsed:
    """Load a checkpoint or a run, and let it act; `device` and `dtype` are used of the options."""
    reset_peak()
    before, folder = peak_rss_bytes(), find_checkpoint(path)
    if (folder / ADAPTER_CONFIG_FILE).is_file():
        raise CheckpointError(
            f"{folder}: expected whole weights, found a LoRA adapter. Merge it first: "
            f"mikasa-vla checkpoint merge {path} --out DIR"
        )
    config = read_config(folder, LoadOptions(device=options.device, dtype=options.dtype))
    estimated = _estimate(make_unfilled_policy(config), options.device, before, trained=None)
    return _measured(_Loading(str(path), folder, config, options), before, estimated, batches=())


def _rehearse(
    name: str, recipe: FinetuneRecipe, options: RehearsalOptions, before: int, batches: Sequence[int]
) -> Rehearsed:
    config, tokenizer = stand_in_config(recipe, options.folder, dtype=options.dtype, tiny=options.tiny)
    trained = describe_model(unfilled_model(config, recipe)).n_trained
    config.pretrained_path = None
    policy = make_unfilled_policy(config)
    estimated = _estimate(policy, options.device, before, trained=trained)
    folder = options.folder / "model"
    folder.mkdir()
    reset_peak()
    started = time.perf_counter()
    write_checkpoint(folder, config, policy, tokenizer)
    written = _Loading(
        name,
        folder,
        config,
        options,
        recipe=recipe,
        seconds={"write": time.perf_counter() - started},
        peaks={"write": peak_rss_bytes()},
    )
    del policy
    return _measured(written, before, estimated, batches)


@dataclass
class _Loading:
    """What is loaded, and what was measured up to now, by stage."""

    name: str
    folder: Path
    config: Any
    options: RehearsalOptions
    recipe: FinetuneRecipe | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, int] = field(default_factory=dict)


def _measured(one: _Loading, before: int, estimated: Estimated, batches: Sequence[int]) -> Rehearsed:
    n_bytes = (one.folder / WEIGHTS_FILE).stat().st_size
    limit, device = limit_bytes(n_bytes), one.options.device
    available = available_ram_bytes()
    if device == "cpu" and available < limit:
        raise CheckpointError(
            f"expected {limit / GB:.1f} GB of memory for this model, found {available / GB:.1f} GB "
            "available. Close other programs, or rehearse it on another machine."
        )
    model = _load_and_act(one)
    on_device = peak_device_bytes(device)
    parameters = sum(x.numel() for x in model.parameters())
    trained = None
    if one.recipe is not None:  # its adapters get no memory
        adapted = with_adapters(model, one.recipe)
        trained = sum(x.numel() for x in adapted.parameters() if x.requires_grad)
        del adapted
    del model
    return Rehearsed(
        recipe=one.name,
        kind=one.config.type,
        dtype=str(getattr(one.config, "dtype", "float32")),
        device=device,
        parameters=parameters,
        trained=trained,
        bytes=n_bytes,
        peak_rss_bytes=one.peaks,
        peak_device_bytes=on_device,
        seconds=one.seconds,
        inferences=inference_rates(one.folder, device, batches) if batches else {},
        before_bytes=before,
        limit_bytes=limit,
        estimated=estimated,
    )


def _estimate(policy: Any, device: str, before: int, *, trained: int | None) -> Estimated:
    """Estimate from shapes what is about to be measured.

    While it writes, a process holds a part of the numbers, in float32 and in the file's type. Loaded, it
    holds the weights. An inference adds what the largest layer reads and writes for one sample. `trained` is
    what the recipe trains; None: nothing is written.
    """
    weights = {id(x): x for x in policy.state_dict(keep_vars=True).values()}.values()
    n_bytes = sum(x.numel() * x.element_size() for x in weights)
    cost = sample_cost(policy, policy.config)
    acting = {} if cost is None else {"act": n_bytes + round(cost.inference_bytes)}
    in_parts = PART * sum({torch.float32.itemsize, *(x.element_size() for x in weights)})
    peaks = {"write": in_parts} if trained is not None else {}
    if device == "cpu":
        peaks |= {"load": n_bytes, **acting}
    return Estimated(
        parameters=sum(x.numel() for x in policy.parameters()),
        trained=trained,
        bytes=n_bytes,
        peak_rss_bytes={stage: before + added for stage, added in peaks.items()},
        peak_device_bytes=acting.get("act") if device != "cpu" else None,
    )


class _Timed:
    """A policy whose inferences are timed."""

    def __init__(self, policy: Any) -> None:
        self._policy, self.spec = policy, policy.spec
        self.seconds: list[float] = []

    def reset(self, episodes: Any) -> None:
        self._policy.reset(episodes)

    def act(self, window: ObservationWindow) -> ActionChunk:
        started = time.perf_counter()
        chunk: ActionChunk = self._policy.act(window)
        self.seconds.append(time.perf_counter() - started)
        return chunk


def _load_and_act(one: _Loading) -> Any:
    """Load by an evaluation's strict door, run an episode on the fake simulator; return the model."""
    env = make_env(
        EnvSettings(
            task=TASK, kwargs={"horizon_steps": N_STEPS}, simulator="fake", cameras=tuple(CAMERA_KEYS)
        )
    )
    n_action_steps = int(getattr(one.config, "n_action_steps", 1))
    chunking = ChunkingSpec(n_action_steps=min(n_action_steps, N_STEPS // 2))
    context = PolicyContext(name="rehearsal", env=env.spec, chunking=chunking, n_candidates=3)
    not_cameras = getattr(one.config, "memory_fields", ())
    fields = [field for field in one.config.image_features if field not in not_cameras]
    cameras, device = dict(zip(CAMERA_KEYS, fields, strict=True)), one.options.device
    reset_peak()
    reset_device_peak(device)
    started = time.perf_counter()
    dtype: Any = one.options.dtype
    loaded = make_lerobot(
        context, checkpoint=str(one.folder), device=device, dtype=dtype, cameras=cameras, batch=False
    )
    one.seconds["load"], one.peaks["load"] = time.perf_counter() - started, peak_rss_bytes()
    reset_peak()
    timed: Any = _Timed(loaded)
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="pick the cube", horizon_steps=N_STEPS)
    policy: Policy = timed
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
    assert record.error is None  # else it was raised
    one.peaks["act"] = peak_rss_bytes()
    one.seconds |= {"first_inference": timed.seconds[0], "second_inference": timed.seconds[1]}
    return loaded._loaded.policy
