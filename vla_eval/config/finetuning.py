"""The `finetune` section of `policies/*.yaml`, and one fine-tuning. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from vla_eval.config.environment import Simulator
from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import (
    MAX_BATCH,
    MAX_PROCESSES,
    Bounds,
    Episodes,
    Slots,
    Steps,
    TrainingSteps,
    Workers,
    check_bounds,
    check_seeds,
)
from vla_eval.strict.devices import check_device
from vla_eval.strict.renamed import formerly

Rank = Annotated[int, Bounds(1, 65_536)]  # of a LoRA adapter: no layer of these policies is wider

LOGGERS = ("wandb_project", "trackio_project", "tensorboard")
"""Fields of a recipe that may be changed when a run is resumed: no weight depends on them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoraRecipe:
    """Train low-rank adapters instead of all weights."""

    rank: Rank = 16
    alpha: Rank | None = None  # scaling is alpha / rank; None: alpha = rank (peft would take 8)
    # regular expression of the modules that get one; None: the choice of our policy, or of lerobot
    target_modules: str | None = None
    full_modules: tuple[str, ...] = ()  # last names of modules that are trained in full in addition

    def __post_init__(self) -> None:
        check_bounds(self, prefix="finetune.lora.")
        if self.target_modules == "all-linear":
            raise RecipeError(
                "finetune.lora.target_modules is 'all-linear', which takes heads and embeddings of a policy, "
                "too. Write a regular expression of the modules' names."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneRecipe:
    """How to fine-tune one type of policy. `docs/finetuning.md` has the table of all fields."""

    type: str
    policy: dict[str, Any] = field(default_factory=dict)  # Any: lerobot checks its own fields
    base_checkpoint: str | None = None
    tokenizer: str | None = None
    rename_cameras: dict[str, str] = field(default_factory=dict)
    lora: LoraRecipe | None = None
    steps: TrainingSteps = 50_000
    batch_size: Annotated[int, Bounds(1, MAX_BATCH)] = 32
    micro_batch_size: int | None = None
    save_every_steps: TrainingSteps = 5_000
    log_every_steps: TrainingSteps = 100
    num_workers: Annotated[int, Bounds(0, MAX_PROCESSES)] = 4
    failed_episodes: Literal["keep", "leave_out"] | None = None
    decode_ahead: bool = True
    image_transforms: dict[str, Any] | None = None  # Any: lerobot checks its own fields
    imagenet_statistics: bool = False
    wandb_project: str | None = None
    trackio_project: str | None = None
    tensorboard: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, prefix="finetune.")
        if self.micro_batch_size is not None and not 1 <= self.micro_batch_size <= self.batch_size:
            raise RecipeError(
                f"finetune.micro_batch_size is {self.micro_batch_size}, expected a number from 1 to "
                f"batch_size ({self.batch_size}), or null."
            )
        if self.lora is not None and self.base_checkpoint is None:
            raise RecipeError(
                "finetune.lora: adapters are trained on top of a base; name its folder with "
                "finetune.base_checkpoint."
            )
        if self.rename_cameras and self.base_checkpoint is None:
            raise RecipeError(
                "finetune.rename_cameras is for a base_checkpoint whose cameras have other names; from "
                "scratch, the dataset's names are used."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutConfig:
    """Evaluate checkpoints on held-out seeds during training. Moves no weight.

    `docs/finetuning.md` has the table of all fields.
    """

    every_steps: TrainingSteps
    episodes: Episodes = 20
    seed_start: int = 900_000  # far above the seeds of demonstrations
    task: str | None = None
    n_action_steps: Steps | None = None
    env: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    simulator: Simulator = "maniskill"
    slots_per_worker: Slots = 1
    workers: Workers = "auto"

    def __post_init__(self) -> None:
        check_bounds(self, prefix="held_out.")
        check_seeds(self.seed_start, self.episodes, name="held_out.seed_start")


@dataclass(frozen=True, slots=True, kw_only=True)
class FinetuneConfig:
    """One fine-tuning, as `mikasa-vla finetune CONFIG` reads it."""

    policy: str  # name of a recipe in `policies/` that has a `finetune` section
    dataset: str
    out: str | None = None  # the run folder; None: `runs/POLICY-DATASET-SEED`
    run_seed: int = 0  # of initial weights, order of samples and noise
    # fields of the recipe's `finetune` section, set to other values; Any: decoded as a FinetuneRecipe
    finetune: dict[str, Any] = field(default_factory=dict)
    device: str = "auto"
    # None: no checkpoint is evaluated during training
    held_out: HeldOutConfig | None = field(default=None, metadata=formerly("evaluation"))
    allow_unreplayed: bool = False  # train on a dataset that no replay has confirmed; noted in the run

    def __post_init__(self) -> None:
        check_seeds(self.run_seed, name="run_seed")
        check_device(self.device)


def merge_fields(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:  # Any: plain data
    """Put changes on top, field by field; an empty mapping empties."""
    merged = dict(base)
    for name, value in changes.items():
        inner = merged.get(name)
        merges = isinstance(inner, dict) and isinstance(value, dict) and value
        merged[name] = merge_fields(inner, value) if merges and inner else value
    return merged
