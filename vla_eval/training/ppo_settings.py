"""What learning an expert depends on, as data. Imports nothing heavy."""

from dataclasses import dataclass, field
from typing import Any

from vla_eval.envs.settings import Simulator


@dataclass(frozen=True, slots=True, kw_only=True)
class PpoSettings:
    """What learning depends on; two equal settings learn the same, whatever the number of processes.

    Discount, clipping and the length of a rollout (one episode) are the paper's; batch, network and rate
    are scaled from 1024 environments on a GPU to a few on a processor.
    """

    task: str
    seed: int = 0
    env_kwargs: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    simulator: Simulator = "maniskill"
    n_envs: int = 16
    n_epochs: int = 8
    n_minibatches: int = 8
    discount: float = 0.8
    gae_lambda: float = 0.9
    learning_rate: float = 1e-3
    clip: float = 0.2
    value_weight: float = 0.5
    max_gradient_norm: float = 0.5
    max_kl: float = 0.1
    hidden: tuple[int, ...] = (128, 128)
    initial_std: float = 0.4
