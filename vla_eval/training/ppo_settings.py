"""What learning an expert depends on, as data. Imports nothing heavy."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vla_eval.core import FloatArray
from vla_eval.envs.settings import Simulator
from vla_eval.errors import RecipeError, check_names

ACTION_DIMS = ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")  # of pd_ee_delta_pose


@dataclass(frozen=True, slots=True, kw_only=True)
class PpoSettings:
    """What learning depends on; two equal settings learn the same, whatever the number of processes.

    The length of a rollout (one episode), the losses and the learning rate are those of the paper's PPO.
    Batch and network are scaled from 1024 environments on a GPU to a few on a processor. Two things differ
    because RememberColor3 was not learned otherwise within 10^5 steps (`docs/experts.md`): the discount
    (theirs is 0.8), and that rotation and gripper are held, which a reaching arm does not need.

    Attributes:
        task, env_kwargs, simulator: the environment.
        seed: of episodes, noise, weights and shuffles.
        learned_dims: the dimensions of the action that are learned; the others are held.
        held_gripper: the gripper's command while it is not learned; 1 is open.
        n_envs: episodes per iteration.
        n_epochs, n_minibatches: how often, and in how many parts, each iteration is learned from.
        discount, gae_lambda: of rewards and errors that come later.
        shaping_per_m: reward, while learning, per metre by which a step brings things nearer to where the
            task wants them. Not discounted, unlike the potentials of Ng et al. 1999, which have the learned
            values carry the whole distance.
        learning_rate, clip, value_weight, max_gradient_norm: as PPO has them.
        max_kl: no further epoch once the policy has moved so far.
        hidden: sizes of the hidden layers of actor and critic.
        initial_std: spread of the first actions.
    """

    task: str
    seed: int = 0
    env_kwargs: dict[str, Any] = field(default_factory=dict)  # Any: the task checks its arguments
    simulator: Simulator = "maniskill"
    learned_dims: tuple[str, ...] = ("dx", "dy", "dz")
    held_gripper: float = 1.0
    n_envs: int = 16
    n_epochs: int = 8
    n_minibatches: int = 8
    discount: float = 0.95
    gae_lambda: float = 0.9
    shaping_per_m: float = 20.0
    learning_rate: float = 3e-4
    clip: float = 0.2
    value_weight: float = 0.5
    max_gradient_norm: float = 0.5
    max_kl: float = 0.1
    hidden: tuple[int, ...] = (128, 128)
    initial_std: float = 0.4

    def __post_init__(self) -> None:
        """Check that the dimensions are some of the action's."""
        check_names("dimension of the action", self.learned_dims, ACTION_DIMS)
        if not self.learned_dims or len(set(self.learned_dims)) != len(self.learned_dims):
            raise RecipeError(
                f"learned_dims is {self.learned_dims}, expected at least one, none of them twice."
            )

    def full_actions(self, learned_BL: FloatArray) -> FloatArray:  # shape suffix
        """Return (B, 7) actions of the environment for (B, L) learned ones, not clipped."""
        actions = np.zeros((len(learned_BL), len(ACTION_DIMS)), dtype=np.float32)
        actions[:, -1] = self.held_gripper
        actions[:, [ACTION_DIMS.index(name) for name in self.learned_dims]] = learned_BL
        return actions
