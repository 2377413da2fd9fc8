"""The `train_agent` section of `policies/*.yaml`, and one training by rewards. Standard library only."""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from vla_eval.config.environment import SimBackend, Simulator
from vla_eval.config.files import check_run_name, recipe_fields
from vla_eval.config.finetuning import HeldOutConfig, merge_fields
from vla_eval.errors import RecipeError, check_names
from vla_eval.strict.bounds import Slots, TrainingSteps, Workers, check_bounds, check_seeds, require
from vla_eval.strict.devices import check_device

Algorithm = Literal["ppo", "ppo_lstm", "sac", "imitation"]
Observed = Literal["state", "vector", "rgb_joints", "image"]
Rewards = Literal["dense", "sparse"]

TRAINING_SEEDS = range(1_000_000, 2**31)
"""Of trainings' episodes. Tables are made from 1 to 100; checkpoints are evaluated on 900,000 and above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentRecipe:
    """How to train an agent by rewards. `docs/agents.md` has the table of all fields."""

    algorithm: Algorithm
    observation: Observed | None = None  # what the agent is given; None: what its suite has
    reward: Rewards = "dense"
    env: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    steps: TrainingSteps = 1_000_000  # of all environments together
    n_envs: Slots = 16
    save_every_steps: TrainingSteps = 50_000
    # of the library's class (`n_steps`, `batch_size`, `gamma` …); Any: checked by its signature
    arguments: dict[str, Any] = field(default_factory=dict)
    # of its network (`net_arch`, `activation`, `lstm_hidden_size` …); Any: likewise
    network: dict[str, Any] = field(default_factory=dict)
    anneal_lr: bool = False  # the learning rate falls to zero by the last step
    tensorboard: bool = False
    simulator: Simulator = "maniskill"
    sim_backend: SimBackend = "cpu"  # `gpu`: all environments of a robot are one, in one process

    def __post_init__(self) -> None:
        check_bounds(self, prefix="train_agent.")


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """One training, as `mikasa-vla train-agent CONFIG` reads it."""

    policy: str  # name of a recipe in `policies/` that has a `train_agent` section
    task: str
    out: str | None = None  # the run folder; None: `runs/POLICY-TASK-SEED`
    label: str | None = None  # what it is called in folders and tables; None: the recipe's name
    run_seed: int = 0  # of initial weights, exploration, and the seeds of the training's episodes
    # fields of the recipe's section, set to other values; Any: decoded as an AgentRecipe
    train_agent: dict[str, Any] = field(default_factory=dict)
    device: str = "auto"
    workers: Workers = "auto"  # processes that simulate; moves no result
    held_out: HeldOutConfig | None = None  # None: no checkpoint is evaluated during training

    def __post_init__(self) -> None:
        check_bounds(self)
        check_seeds(self.run_seed, name="run_seed")
        check_device(self.device)
        if self.label is not None:
            check_run_name(self.label)


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentTable:
    """Several trainings, as `mikasa-vla train-agent CONFIG` reads them.

    Each recipe, in each variant, for each task and run seed.
    """

    name: str
    policies: tuple[str, ...]  # recipes
    tasks: tuple[str, ...]
    description: str = ""
    run_seeds: tuple[int, ...] = (0,)
    # as in `AgentConfig`, for each of them
    train_agent: dict[str, Any] = field(default_factory=dict)  # Any: decoded as an AgentRecipe
    # task -> what is different there, on top of `train_agent`
    of_tasks: dict[str, dict[str, Any]] = field(default_factory=dict)  # Any: likewise
    # name -> what it changes of the recipe's section, on top of these; none: the recipes as they are
    variants: dict[str, dict[str, Any]] = field(default_factory=dict)  # Any: likewise
    device: str = "auto"
    workers: Workers = "auto"
    held_out: HeldOutConfig | None = None

    def __post_init__(self) -> None:
        check_bounds(self)
        for name in self.variants:
            check_run_name(name)
        for name in ("policies", "tasks", "run_seeds"):
            found = getattr(self, name)
            require(bool(found) and len(set(found)) == len(found), name, list(found), "some, none twice")
        check_names("task", self.of_tasks, self.tasks, where="of_tasks")
        if self.variants and len(self.policies) > 1:
            raise RecipeError(
                f"variants: expected one recipe in `policies`, whose variants they are, found "
                f"{', '.join(self.policies)}. Give the others a file of their own."
            )

    def of(self, task: str, variant: str | None) -> dict[str, Any]:  # Any: plain data of YAML
        """Return what trainings of a variant on a task have in common, as their configurations have it."""
        changes = {} if variant is None else self.variants[variant]
        section = merge_fields(self.train_agent, self.of_tasks.get(task, {}))
        same: dict[str, Any] = {
            "train_agent": merge_fields(section, changes),
            "device": self.device,
            "workers": self.workers,
            **({} if variant is None else {"label": variant}),
        }
        return same if self.held_out is None else {**same, "held_out": asdict(self.held_out)}


def is_agent_table(name: str) -> bool:
    """Whether a configuration is of several trainings; errors are those of `recipe_fields`."""
    fields = recipe_fields("configs", name)
    return "rows" not in fields and not fields.isdisjoint({"run_seeds", "variants"})
