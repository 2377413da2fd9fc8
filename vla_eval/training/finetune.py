"""Fine-tune: recipe and dataset in, a run folder with checkpoints out; the same call goes on after a kill."""

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped
from unittest.mock import patch

from lerobot.configs.default import DatasetConfig, PeftConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class

from vla_eval.data.features import CAMERA_KEYS
from vla_eval.data.opening import video_decoder
from vla_eval.decoding import decode
from vla_eval.errors import RecipeError
from vla_eval.policies.checkpoint import (
    MODEL_FOLDER,
    TrainingFacts,
    checkpoint_sha256,
    find_checkpoint,
)
from vla_eval.policies.foreign_code import no_foreign_code
from vla_eval.policies.lerobot import choose_device
from vla_eval.policies.lerobot_loading import config_class
from vla_eval.policies.steps.trainable import check_lora
from vla_eval.provenance import collect_environment
from vla_eval.recipes import PolicyRecipe, Recipe, load_recipe, to_data
from vla_eval.results.durable import FolderLock
from vla_eval.training.allocator import keep_freed_memory
from vla_eval.training.dataset import TrainingDataset, training_dataset
from vla_eval.training.description import describe_model
from vla_eval.training.held_out import HeldOut, check_held_out
from vla_eval.training.loop import LoopHooks, append_metrics, run_loop
from vla_eval.training.policy_config import image_transforms, masks_padding, policy_config, used_frames
from vla_eval.training.recipe import FinetuneConfig, FinetuneRecipe, LoraRecipe, merge_fields
from vla_eval.training.run_folder import (
    LOG_FILE,
    METRICS_FILE,
    TRAIN_FOLDER,
    open_folder,
    read_metrics,
)
from vla_eval.training.trackers import Log, log_to_wandb, trackio_run

LOCK_FILE = "finetune.lock"
TOKENIZER_STEP = "TokenizerProcessorStep"
LORA_TARGETS = {
    "pi05": r"(.*\.gemma_expert\..*\.self_attn\.(q|v)_proj"
    r"|model\.(action_in_proj|action_out_proj|time_mlp_in|time_mlp_out))"
}
"""By type, where lerobot 0.6.1 chooses wrongly: it looks for π0.5's projections of time under π0's names, and
leaves them frozen (https://github.com/huggingface/lerobot/pull/4494)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneSummary:
    """What a call has come to: the run folder, and the checkpoint that an evaluation takes."""

    out: Path
    checkpoint: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class _Listeners:
    """Who is told of a training: a person, a tracker of metrics, and whoever evaluates checkpoints."""

    say: Callable[[str], None]
    track: Log
    held_out: HeldOut | None


def default_out(config: FinetuneConfig) -> Path:
    """Return the run folder of a fine-tuning that names none."""
    return (
        Path("runs") / f"{Path(config.policy).stem}-{Path(config.dataset).resolve().name}-{config.run_seed}"
    )


def load_finetune_recipe(config: FinetuneConfig) -> Recipe[FinetuneRecipe]:
    """Return the policy's recipe for fine-tuning, with the configuration's values on top.

    Raises:
        RecipeError: the policy has none, or a field is wrong.
    """
    recipe = load_recipe("policies", config.policy, PolicyRecipe)
    if recipe.value.finetune is None:
        raise RecipeError(
            f"policies/{recipe.name}.yaml has no section `finetune`: there is nothing to train. "
            f"`mikasa-vla list policies` shows the recipes."
        )
    data = merge_fields(to_data(recipe.value.finetune), config.finetune)
    value = decode(FinetuneRecipe, data, where=f"policies/{recipe.name}.yaml, finetune")
    return Recipe(name=recipe.name, path=recipe.path, sha256=recipe.sha256, value=value)


def finetune(
    config: FinetuneConfig, *, command: str = "", say: Callable[[str], None] = lambda _line: None
) -> FinetuneSummary:
    """Fine-tune, or go on with it.

    Args:
        config: what to train on what.
        command: what the user typed, for the record.
        say: is given lines for a person.

    Raises:
        VlaEvalError: a mistake; what was saved stays.
    """
    recipe = load_finetune_recipe(config)
    dataset = training_dataset(Path(config.dataset), allow_unreplayed=config.allow_unreplayed)
    task = None
    if config.evaluation is not None:
        task = check_held_out(config.evaluation, recipe.value, dataset)
    device = choose_device(config.device)
    if device == "cpu":
        keep_freed_memory()
    _check_lora_is_told(recipe.value)
    policy = policy_config(recipe.value, dataset, device=device)
    image_transforms(recipe.value)  # refused before the run has a folder
    frames = used_frames(policy, dataset)
    out = Path(config.out) if config.out is not None else default_out(config)
    say(
        f"dataset: {dataset.name} {dataset.sha256[:12]}, {frames.n_used} of {frames.n_frames} frames as "
        "starts"
    )
    if not masks_padding(policy):
        say(
            "padded actions: this policy does not mask them; chunks that go beyond an episode's end are left "
            "out"
        )
    out.mkdir(parents=True, exist_ok=True)
    with _lock(out):
        resume_from = _open(out, recipe, dataset, config, command)
        say(f"run: {out}" + (f", going on from step {int(resume_from.name)}" if resume_from else ""))
        project = recipe.value.trackio_project if _is_first_process() else None
        with trackio_run(project, name=out.resolve().name, settings=to_data(recipe.value)) as track:
            held_out = _held_out(config, recipe.value, task, out, say, track)
            if held_out is not None:
                held_out.catch_up(read_metrics(out))
            listeners = _Listeners(say=say, track=track, held_out=held_out)
            _train(recipe.value, dataset, policy, config, out, resume_from, listeners)
    return FinetuneSummary(out=out, checkpoint=find_checkpoint(out))


def _train(
    recipe: FinetuneRecipe,
    dataset: TrainingDataset,
    policy: Any,
    config: FinetuneConfig,
    out: Path,
    resume_from: Path | None,
    listeners: "_Listeners",
) -> None:
    if resume_from is not None and int(resume_from.name) >= recipe.steps:
        return
    base = find_checkpoint(Path(recipe.base_checkpoint)) if recipe.base_checkpoint else None
    policy.pretrained_path = base
    # Of a LoRA run the adapter names its base; of all others the checkpoint is whole.
    weights = resume_from / MODEL_FOLDER if resume_from is not None else base

    def describe(model: Any) -> None:
        if recipe.lora is not None:
            target, full_modules = _lora_targets(recipe.lora, policy)
            if target is not None:
                check_lora(model, target, full_modules)
        for line in describe_model(model).lines():
            listeners.say(line)

    def report(line: Mapping[str, float]) -> None:
        seconds = line["update_s"] + line["dataloading_s"]
        listeners.say(
            f"step {int(line['step'])}/{recipe.steps}  loss {line['loss']:.4f}  lr {line['lr']:.2e}  "
            f"{seconds:.3f} s/step, {(recipe.steps - line['step']) * seconds / 60:.0f} min left"
        )
        listeners.track(line)

    def evaluate(checkpoint: Path) -> None:
        held_out = listeners.held_out
        if held_out is not None and held_out.is_due(int(checkpoint.name)):
            held_out.evaluate(checkpoint)

    whole_episodes = getattr(policy, "whole_episodes", False)
    if whole_episodes and not recipe.decode_ahead:
        raise RecipeError(
            f"finetune.decode_ahead is false; '{recipe.type}' is trained on whole episodes, which are served "
            "from decoded frames alone. Leave the field out."
        )
    hooks = LoopHooks(
        facts=_facts(dataset, policy, config, out),
        metrics_file=out / METRICS_FILE,
        log_file=out / LOG_FILE,
        log_every_steps=recipe.log_every_steps,
        run_seed=config.run_seed,
        weights=weights,
        cast=base is not None,
        begins_from_base=base is not None and resume_from is None,
        decode_ahead=recipe.decode_ahead,
        whole_episodes=whole_episodes,
        micro_batch_size=recipe.micro_batch_size,
        tokenizer=recipe.tokenizer,
        on_model=describe,
        on_metrics=report,
        on_checkpoint=evaluate,
    )
    loop_config = _loop_config(recipe, dataset, policy, config.run_seed, out, resume=resume_from is not None)
    with _tokenizer_from(recipe.tokenizer, recipe.type), no_foreign_code(recipe.type):
        run_loop(loop_config, hooks, resume_from=resume_from)


def _lora_targets(lora: LoraRecipe, policy: Any) -> tuple[str | None, tuple[str, ...]]:
    """Return what LoRA is put on and what is trained whole: the recipe's, else the policy's own choice."""
    own = policy.lora_defaults() if hasattr(policy, "lora_defaults") else {}
    return (
        lora.target_modules or LORA_TARGETS.get(policy.type) or own.get("target_modules"),
        tuple(lora.full_modules or own.get("modules_to_save") or ()),
    )


def _check_lora_is_told(recipe: FinetuneRecipe) -> None:
    """Refuse LoRA where neither the recipe nor the policy says which layers get an adapter."""
    if recipe.lora is None or recipe.lora.target_modules is not None:
        return
    if hasattr(config_class(recipe.type, where="finetune.type"), "lora_defaults"):
        return
    chosen = get_policy_class(recipe.type)._get_default_peft_targets
    if chosen is PreTrainedPolicy._get_default_peft_targets:
        raise RecipeError(
            f"finetune.lora.target_modules is not set, and '{recipe.type}' does not say itself which layers "
            f"get an adapter. Write a regular expression of whole module names, or leave `lora` out."
        )


def _held_out(
    config: FinetuneConfig,
    recipe: FinetuneRecipe,
    task: str | None,
    out: Path,
    say: Callable[[str], None],
    track: Log,
) -> HeldOut | None:
    if config.evaluation is None or task is None or not _is_first_process():
        return None

    def report(line: Mapping[str, float | str]) -> None:
        append_metrics(out / METRICS_FILE, line)
        track(line)
        log_to_wandb(line)

    return HeldOut(
        settings=config.evaluation, task=task, out=out, last_step=recipe.steps, on_metrics=report, say=say
    )


def _is_first_process() -> bool:
    return os.environ.get("RANK", "0") == "0"  # of several that accelerate has started


def _loop_config(
    recipe: FinetuneRecipe, dataset: TrainingDataset, policy: Any, run_seed: int, out: Path, *, resume: bool
) -> Any:
    lora = recipe.lora
    config = TrainPipelineConfig(
        dataset=DatasetConfig(
            repo_id=f"local/{dataset.name}",
            root=str(dataset.root),
            use_imagenet_stats=recipe.imagenet_statistics,
            image_transforms=image_transforms(recipe),
            video_backend=video_decoder(),
        ),
        policy=policy,
        output_dir=out / TRAIN_FOLDER,
        resume=resume,
        seed=run_seed,
        steps=recipe.steps,
        batch_size=recipe.batch_size,
        num_workers=min(recipe.num_workers, len(os.sched_getaffinity(0))),  # more would only wait
        log_freq=recipe.log_every_steps,
        save_freq=recipe.save_every_steps,
        env_eval_freq=0,
        rename_map=dict(recipe.rename_cameras),
        wandb=WandBConfig(enable=recipe.wandb_project is not None, project=recipe.wandb_project or "none"),
        peft=None
        if lora is None
        else PeftConfig(
            r=lora.rank,
            lora_alpha=lora.alpha or lora.rank,
            target_modules=lora.target_modules or LORA_TARGETS.get(recipe.type),
            full_training_modules=list(lora.full_modules) or None,
        ),
    )
    if resume:  # lerobot then expects them from the file that it does not read here
        config.optimizer = policy.get_optimizer_preset()
        config.scheduler = policy.get_scheduler_preset()
    return config


def _facts(dataset: TrainingDataset, policy: Any, config: FinetuneConfig, out: Path) -> TrainingFacts:
    features = dataset.meta.features
    return TrainingFacts(
        run=out.resolve().name,
        dataset=dataset.name,
        dataset_sha256=dataset.sha256,
        task=dataset.task,
        state=dataset.state,
        images={field: tuple(features[field]["shape"][:2]) for field in CAMERA_KEYS.values()},
        fps=float(dataset.meta.fps),
        action_names=tuple(features["action"]["names"]),
        control_mode=dataset.control_mode,
        run_seed=config.run_seed,
    )


def _open(
    out: Path, recipe: Recipe[FinetuneRecipe], dataset: TrainingDataset, config: FinetuneConfig, command: str
) -> Path | None:
    value = recipe.value
    section = to_data(value)
    del section["trackio_project"]  # may be changed while a run goes on
    settings: dict[str, Any] = {  # Any: plain data
        "finetune": section,
        "dataset": {"name": dataset.name, "sha256": dataset.sha256},
        "run_seed": config.run_seed,
        "base_sha256": checkpoint_sha256(Path(value.base_checkpoint)) if value.base_checkpoint else None,
    }
    record: dict[str, Any] = {  # Any: plain data
        "policy": recipe.name,
        "recipe_sha256": recipe.sha256,
        "dataset_was_replayed": dataset.was_replayed,
        "environment": collect_environment(),
        "command": command,
    }
    return open_folder(out, settings, record, ignore=frozenset({LOCK_FILE}))


@contextlib.contextmanager
def _lock(out: Path) -> Any:
    if not _is_first_process():  # the first one has it
        yield
        return
    lock = FolderLock(out / LOCK_FILE)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def _tokenizer_from(folder: str | None, kind: str) -> Any:
    """Let the policy's processors use this tokenizer: lerobot has the names of π0's written into its code."""
    if folder is None:
        yield
        return
    import importlib

    name = config_class(kind, where="finetune.type").__module__.replace("configuration_", "processor_")
    processing: Any = importlib.import_module(name)
    if not Path(folder).is_dir() or not hasattr(processing, TOKENIZER_STEP):
        raise RecipeError(
            f"finetune.tokenizer: expected the folder of a tokenizer and a policy that uses one, found "
            f"{folder} and '{kind}'."
        )
    step = getattr(processing, TOKENIZER_STEP)
    with patch.object(
        processing, TOKENIZER_STEP, lambda **fields: step(**{**fields, "tokenizer_name": folder})
    ):
        yield
