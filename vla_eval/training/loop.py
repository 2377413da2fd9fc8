"""lerobot's own training loop, with some of the names it calls replaced while it runs.

lerobot 0.6.1 has no place to hook into, so names of its module are replaced (the version is pinned, and
a test notices if one is gone):

- `make_policy`: weights of a base are loaded strictly, never by the loaders that swallow errors.
- `make_pre_post_processors`: those of a base or of a checkpoint get the tokenizer that lies on this machine.
- `make_optimizer_and_scheduler`: what is about to be trained is reported.
- `make_train_eval_datasets`: optionally, frames are decoded once and not per sample.
- `update_policy`: all noise of a step is drawn from (run seed, step, process), so that a run that was
  killed goes on exactly as it would have; a batch may go through the network in parts; metrics are
  written.
- `load_training_state`: a damaged state is an error that says what to do; it is safetensors and JSON.
- `save_checkpoint`: a checkpoint appears whole or not at all, and carries what it was trained on; it is
  then shown to whoever evaluates it.
"""

import contextlib
import importlib
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped
from unittest.mock import patch
from urllib.error import URLError

import numpy as np
from accelerate.state import AcceleratorState
from lerobot.utils.random_utils import set_seed

from vla_eval.data.memory_loader import MemoryDataset
from vla_eval.errors import TrainingError
from vla_eval.policies.checkpoint import (
    MODEL_FOLDER,
    POSTPROCESSOR_FILE,
    PREPROCESSOR_FILE,
    TrainingFacts,
    write_facts,
)
from vla_eval.policies.lerobot_loading import LoadOptions, begin_from, fill_policy, raise_plainly
from vla_eval.policies.lerobot_processors import save_tokenizers, step_names, tokenizer_overrides
from vla_eval.policies.steps.step_names import DECODER_STEP, ENCODER_STEP
from vla_eval.training.micro_batches import InMicroBatches

PARTIAL_PREFIX = ".partial-"
REPLACED = (
    "make_policy",
    "make_pre_post_processors",
    "make_optimizer_and_scheduler",
    "make_train_eval_datasets",
    "update_policy",
    "load_training_state",
    "save_checkpoint",
    "init_logging",
    "inside_slurm",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopHooks:
    """What is to happen at the replaced places.

    Attributes:
        facts: written beside each checkpoint's weights.
        metrics_file: one line of JSON per logged step.
        log_file: what lerobot says of itself, warnings apart, which go to standard error, too.
        log_every_steps: how often.
        run_seed: of all noise.
        weights: folder of the weights to start from; None: from scratch.
        cast: whether the weights' precision may differ from the model's.
        begins_from_base: whether they are a base's, which need not have what fine-tuning begins anew.
        decode_ahead, tokenizer: see `FinetuneRecipe`.
        whole_episodes: see `MemoryDataset`.
        micro_batch_size: see `FinetuneRecipe`.
        on_model: called with the model before its optimizer is made.
        on_metrics: called with each line of metrics.
        on_checkpoint: called with the folder of each checkpoint (`…/000100`) once it is there.
    """

    facts: TrainingFacts
    metrics_file: Path
    log_file: Path
    log_every_steps: int
    run_seed: int
    weights: Path | None
    cast: bool
    begins_from_base: bool
    decode_ahead: bool
    whole_episodes: bool
    micro_batch_size: int | None
    tokenizer: str | None
    on_model: Callable[[Any], None]
    on_metrics: Callable[[Mapping[str, float]], None]
    on_checkpoint: Callable[[Path], None]


def run_loop(config: Any, hooks: LoopHooks, *, resume_from: Path | None) -> None:
    """Train.

    Args:
        config: lerobot's `TrainPipelineConfig`.
        hooks: see there.
        resume_from: folder of a checkpoint (`…/000100`) to go on from.
    """
    module: Any = importlib.import_module("lerobot.scripts.lerobot_train")
    for name in REPLACED:
        if not hasattr(module, name):
            raise TrainingError(
                f"the installed lerobot's training loop does not call '{name}' any more. Install the version "
                f"that this package names: pip install lerobot==0.6.1"
            )
    # lerobot reads the command line again, for the checkpoint to go on from.
    arguments = [sys.argv[0]]
    if resume_from is not None:
        arguments.append(f"--config_path={resume_from / MODEL_FOLDER}")
    with (
        patch.object(sys, "argv", arguments),
        _logging_as_it_was(),
        contextlib.ExitStack() as stack,
    ):
        for name, replacement in _replacements(module, hooks).items():
            stack.enter_context(patch.object(module, name, replacement))
        # It is one for the whole process, and refuses a second training in another precision.
        AcceleratorState._reset_state()
        module.train(config)


def _replacements(module: Any, hooks: LoopHooks) -> dict[str, Callable[..., Any]]:
    originals = {name: getattr(module, name) for name in REPLACED}

    def make_policy(*, cfg: Any, ds_meta: Any, rename_map: Any = None) -> Any:
        path, cfg.pretrained_path = cfg.pretrained_path, None  # lerobot's loader is not to be asked
        peft, cfg.use_peft = cfg.use_peft, False
        set_seed(hooks.run_seed)
        try:
            policy = originals["make_policy"](cfg=cfg, ds_meta=ds_meta, rename_map=rename_map or {"": ""})
        except URLError as exc:
            raise TrainingError(
                f"the policy asks for weights that are not on this machine, and they could not be downloaded "
                f"({exc.reason}). Without them: --set policy.pretrained_backbone_weights=null"
            ) from exc
        except (OSError, RuntimeError) as exc:
            raise_plainly(exc, cfg.type)
        cfg.pretrained_path, cfg.use_peft = path, peft
        if hooks.weights is None:
            return policy
        options = LoadOptions(device=cfg.device, dtype=getattr(cfg, "dtype", None) if hooks.cast else None)
        may_be_new = getattr(policy, "new_in_finetuning", ()) if hooks.begins_from_base else ()
        filled = fill_policy(policy, hooks.weights, options, may_be_new=may_be_new)
        if hooks.begins_from_base:
            begin_from(filled, hooks.weights)
        return filled.to(cfg.device)

    def make_pre_post_processors(policy_cfg: Any, pretrained_path: Any = None, **kwargs: Any) -> Any:
        if pretrained_path:
            folder = Path(pretrained_path)
            steps = step_names(folder / PREPROCESSOR_FILE)
            found = tokenizer_overrides(folder, policy_cfg, steps, tokenizer=hooks.tokenizer)
            kwargs["preprocessor_overrides"] = {**kwargs["preprocessor_overrides"], **found}
            _override_our_steps(folder, policy_cfg, kwargs)
        make = originals["make_pre_post_processors"]
        try:
            return make(policy_cfg, pretrained_path=pretrained_path, **kwargs)
        except OSError as exc:
            raise_plainly(exc, policy_cfg.type)

    def make_optimizer_and_scheduler(cfg: Any, policy: Any) -> Any:
        hooks.on_model(policy)
        return originals["make_optimizer_and_scheduler"](cfg, policy)

    def make_train_eval_datasets(cfg: Any) -> Any:
        training, held_out = originals["make_train_eval_datasets"](cfg)
        if not hooks.decode_ahead:
            return training, held_out
        return MemoryDataset(training, whole_episodes=hooks.whole_episodes), held_out

    def update_policy(tracker: Any, policy: Any, *args: Any, **kwargs: Any) -> Any:
        accelerator = kwargs["accelerator"]
        process = accelerator.process_index
        seed_step(hooks.run_seed, tracker.steps, process)
        if hooks.micro_batch_size is not None:
            policy = InMicroBatches(policy, accelerator, hooks.micro_batch_size)
        answer = originals["update_policy"](tracker, policy, *args, **kwargs)
        step = tracker.steps + 1
        if step % hooks.log_every_steps == 0 and process == 0:
            _write_metrics(hooks, step, tracker, answer[1] or {})
        return answer

    def load_training_state(checkpoint_dir: Path, *args: Any, **kwargs: Any) -> Any:
        try:
            return originals["load_training_state"](checkpoint_dir, *args, **kwargs)
        except Exception as exc:  # lerobot, torch and safetensors raise what they like
            raise TrainingError(
                f"{checkpoint_dir}: the state of the training cannot be read ({exc!r:.300}). Remove this "
                "checkpoint's folder to go on from the one before it, or use another --out."
            ) from exc

    def save_checkpoint(checkpoint_dir: Path, **kwargs: Any) -> None:
        partial = checkpoint_dir.with_name(f"{PARTIAL_PREFIX}{checkpoint_dir.name}")
        originals["save_checkpoint"](checkpoint_dir=partial, **kwargs)
        write_facts(partial / MODEL_FOLDER, hooks.facts)
        save_tokenizers(kwargs["preprocessor"], partial / MODEL_FOLDER)
        _sync(partial)
        os.replace(partial, checkpoint_dir)
        hooks.on_checkpoint(checkpoint_dir)

    def init_logging(accelerator: Any = None) -> None:
        is_first = accelerator is None or accelerator.is_main_process
        originals["init_logging"](
            log_file=hooks.log_file if is_first else None,
            console_level="WARNING",
            file_level="INFO",
            accelerator=accelerator,
        )

    def inside_slurm() -> bool:
        """Where lerobot draws no bar: here, too, if nobody would see it move."""
        return originals["inside_slurm"]() or not sys.stderr.isatty()

    replaced = (
        make_policy,
        make_pre_post_processors,
        make_optimizer_and_scheduler,
        make_train_eval_datasets,
        update_policy,
        load_training_state,
        save_checkpoint,
        init_logging,
        inside_slurm,
    )
    return {function.__name__: function for function in replaced}


def seed_step(run_seed: int, step: int, process: int) -> None:
    """Seed all global generators from these three numbers: lerobot's policies draw from them."""
    drawn = np.random.SeedSequence(run_seed, spawn_key=(step, process)).generate_state(1)
    set_seed(int(drawn[0]))


def _write_metrics(hooks: LoopHooks, step: int, tracker: Any, parts: Mapping[str, Any]) -> None:
    """Write means since the last line and, of the loss, the parts that the policy tells of this step."""
    values = {name: value for name, value in tracker.to_dict().items() if name != "steps"}
    told = {name: value for name, value in parts.items() if isinstance(value, float | int)}
    line = {"step": step, **{name: float(value) for name, value in {**told, **values}.items()}}
    append_metrics(hooks.metrics_file, line)
    hooks.on_metrics(line)
    if not np.isfinite(line["loss"]):
        raise TrainingError(
            f"step {step}: the loss is {line['loss']}. Lower the learning rate, or look for fields of the "
            f"dataset that hardly vary (docs/finetuning.md)."
        )


def append_metrics(file: Path, line: Mapping[str, float | str]) -> None:
    """Write one line of metrics."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(f"{json.dumps(dict(line))}\n")


def _override_our_steps(folder: Path, config: Any, kwargs: dict[str, Any]) -> None:
    """Give our own normaliser what lerobot addresses to its own by name.

    That is the dataset's statistics; with them, the settings of this training and not those of its base.
    """
    for overrides_name, file, lerobots, ours in (
        ("preprocessor_overrides", PREPROCESSOR_FILE, "normalizer_processor", ENCODER_STEP),
        ("postprocessor_overrides", POSTPROCESSOR_FILE, "unnormalizer_processor", DECODER_STEP),
    ):
        names = step_names(folder / file)
        overrides = dict(kwargs.get(overrides_name) or {})
        if ours not in names or lerobots not in overrides:
            continue
        given = overrides.pop(lerobots)
        if "stats" in given:
            overrides[ours] = {**getattr(config, "encoder_settings", {}), "stats": given["stats"]}
        kwargs[overrides_name] = overrides


def _sync(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


@contextlib.contextmanager
def _logging_as_it_was() -> Iterator[None]:
    """Undo what lerobot does to the root logger."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        yield
    finally:
        for handler in root.handlers:
            if handler not in handlers:
                handler.close()
        root.handlers[:] = handlers
        root.setLevel(level)
