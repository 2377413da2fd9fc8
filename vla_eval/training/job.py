"""One fine-tuning, resolved once: all that can be refused is refused here, before the run has a folder."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig

from vla_eval.checkpoints.files import MODEL_FOLDER, TrainingFacts, find_checkpoint, read_facts
from vla_eval.checkpoints.loading import config_class
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe, HeldOutConfig
from vla_eval.control_modes import MOTORS, action_spec
from vla_eval.data.opening import OpenDataset, decoder_for
from vla_eval.errors import RecipeError
from vla_eval.features import RewardKind
from vla_eval.models.shared.earlier_frames import SampleMemory
from vla_eval.policies.lerobot.device import choose_device
from vla_eval.robots.find import robots
from vla_eval.training.dataset import chosen_episodes, training_dataset
from vla_eval.training.held_out import check_asked, check_held_out
from vla_eval.training.policy_config import (
    UsedFrames,
    asked_policy,
    check_lora_targets,
    fit_to_dataset,
    image_transforms,
    peft_config,
    used_frames,
)
from vla_eval.training.request import load_finetune_recipe, run_folder_of
from vla_eval.training.run_folder import TRAIN_FOLDER


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingJob:
    """One fine-tuning."""

    name: str
    recipe_sha256: str
    recipe: FinetuneRecipe  # with the configuration's values on top
    dataset: OpenDataset
    policy: Any  # lerobot's configuration, which it completes when the model is made
    frames: UsedFrames
    base: Path | None  # folder of the weights to start from; None: from scratch
    below: TrainingFacts | None  # what those were trained on; None: from scratch, or not known
    device: str
    out: Path
    run_seed: int
    held_out: HeldOutConfig | None
    held_out_task: str | None
    resume_from: Path | None = None  # folder of the checkpoint (`…/000100`); None: from the beginning
    # names the run to services, also when it is resumed; None: it has no folder yet
    run_id: str | None = None

    @property
    def first_step(self) -> int:
        """Steps that are done."""
        return 0 if self.resume_from is None else int(self.resume_from.name)

    @property
    def weights(self) -> Path | None:
        """Folder of the weights to load: the checkpoint's, else the base's."""
        return self.base if self.resume_from is None else self.resume_from / MODEL_FOLDER

    @property
    def whole_episodes(self) -> bool:
        """Whether a sample is an episode up to its end, see `DecodedFramesDataset`."""
        return bool(getattr(self.policy, "whole_episodes", False))

    @property
    def reward(self) -> RewardKind | None:
        """Which rewards the policy is trained on; None: it reads none."""
        return getattr(self.policy, "reward", None)

    @property
    def sample_memory(self) -> SampleMemory | None:
        """What a sample has in addition to its own frame, see `RememberedFramesDataset`; None: nothing."""
        return getattr(self.policy, "sample_memory", None)

    @property
    def facts(self) -> TrainingFacts:
        """What is written next to each checkpoint's weights."""
        dataset, below, facts = self.dataset, self.below, self.dataset.facts
        features = dataset.meta.features
        return TrainingFacts(
            run=self.out.resolve().name,
            dataset=dataset.name,
            dataset_sha256=dataset.sha256,
            task=facts.task or "",
            state=facts.state,
            images={field: tuple(features[field]["shape"][:2]) for field in dataset.cameras},
            fps=float(dataset.meta.fps),
            action_names=tuple(features["action"]["names"]),
            control_mode=facts.control_mode,
            run_seed=self.run_seed,
            seeds=_with_base(dataset.seeds, None if below is None else below.seeds),
            tasks=facts.tasks,
            sentences=_with_base(dataset.sentences, None if below is None else below.sentences),
            gripper_open=None
            if facts.control_mode == MOTORS
            else action_spec(facts.control_mode).gripper_open,
            robot=dataset.meta.robot_type if dataset.meta.robot_type in robots() else None,
        )


def _with_base[T](
    own: dict[str, tuple[T, ...]] | None, below: dict[str, tuple[T, ...]] | None
) -> dict[str, tuple[T, ...]] | None:
    """Return by task what demonstrations have: these, and those that the weights it starts from are of."""
    if below is None or own is None:
        return own if below is None else below
    both = {**below, **own}
    return {task: tuple(dict.fromkeys((*below.get(task, ()), *own.get(task, ())))) for task in both}


def training_job(config: FinetuneConfig) -> TrainingJob:
    """Return the fine-tuning that a configuration asks for, from its beginning.

    Raises:
        VlaEvalError: recipe, dataset, base, policy and evaluation do not fit each other.
    """
    loaded = load_finetune_recipe(config)
    recipe = loaded.value
    dataset = training_dataset(Path(config.dataset), allow_unreplayed=config.allow_unreplayed)
    held_out = config.held_out
    task = None if held_out is None else check_held_out(held_out, recipe, dataset)
    device = choose_device(config.device)
    cls = config_class(recipe.type, where="finetune.type")
    check_lora_targets(recipe, cls)
    base = find_checkpoint(Path(recipe.base_checkpoint)) if recipe.base_checkpoint else None
    policy = asked_policy(recipe, cls, base, device=device)
    dataset = chosen_episodes(dataset, recipe, policy)
    fit_to_dataset(policy, recipe, dataset)
    image_transforms(recipe)
    job = TrainingJob(
        name=loaded.name,
        recipe_sha256=loaded.sha256,
        recipe=recipe,
        dataset=dataset,
        policy=policy,
        frames=used_frames(policy, dataset),
        base=base,
        below=None if base is None else read_facts(base),
        device=device,
        out=run_folder_of(config),
        run_seed=config.run_seed,
        held_out=held_out,
        held_out_task=task,
    )
    if held_out is not None and task is not None:
        check_asked(held_out, task, job.facts, policy=job.name)
    needs = "whole episodes" if job.whole_episodes else "rewards" if job.reward is not None else None
    needs = "earlier frames" if job.sample_memory is not None else needs
    if needs is not None and not recipe.decode_ahead:
        raise RecipeError(
            f"finetune.decode_ahead is false; '{recipe.type}' is trained on {needs}, which are served "
            "from decoded frames alone. Leave the field out."
        )
    return job


def lerobot_config(job: TrainingJob) -> Any:
    """Return the same as lerobot's `TrainPipelineConfig`, which its factories take and its checkpoints hold.

    lerobot would complete it from the command line (`validate`); what that sets is set here.
    """
    recipe, dataset = job.recipe, job.dataset
    config = TrainPipelineConfig(
        dataset=DatasetConfig(
            repo_id=f"local/{dataset.name}",
            root=str(dataset.root),
            episodes=dataset.episodes,
            use_imagenet_stats=recipe.imagenet_statistics,
            image_transforms=image_transforms(recipe),
            video_backend=decoder_for(dataset.root),
        ),
        policy=job.policy,
        output_dir=job.out / TRAIN_FOLDER,
        job_name=job.policy.type,
        resume=job.resume_from is not None,
        seed=job.run_seed,
        steps=recipe.steps,
        batch_size=recipe.batch_size,
        num_workers=min(recipe.num_workers, len(os.sched_getaffinity(0))),  # more would only wait
        log_freq=recipe.log_every_steps,
        save_freq=recipe.save_every_steps,
        env_eval_freq=0,
        optimizer=job.policy.get_optimizer_preset(),
        scheduler=job.policy.get_scheduler_preset(),
        rename_map=dict(recipe.rename_cameras),
        wandb=WandBConfig(  # not used here: for `lerobot-train --resume`
            enable=recipe.wandb_project is not None, project=recipe.wandb_project or "none", run_id=job.run_id
        ),
        peft=peft_config(recipe, job.policy),
    )
    config.checkpoint_path = job.resume_from
    return config
