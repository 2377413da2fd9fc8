"""lerobot's configuration of policies that learn from rewards; `docs/offline_rl.md` explains them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_args  # lerobot is untyped

from lerobot.configs import PreTrainedConfig

from vla_eval.control_modes import ABSOLUTE_MODES, CONTROL_MODE, JOINT_DELTA_POS
from vla_eval.errors import RecipeError
from vla_eval.features import RewardKind
from vla_eval.models.sequence.sizes import encoder_stages
from vla_eval.models.shared.ported_config import PortedConfig
from vla_eval.models.shared.stages import HEAD, Stage, Stages, image_shape
from vla_eval.strict.bounds import check_bounds, require

TYPE = "mikasa_offline_rl"
REWARDS: tuple[str, ...] = get_args(RewardKind)
BOUNDS: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(("width", "hidden", "n_sampled_actions"), (1, math.inf)),
    **dict.fromkeys(("dropout", "discount", "expectile", "target_rate"), (0, 1)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmRow:
    """What has to be known of an algorithm before its network is made."""

    reads_rewards: bool = True  # it is more than imitation
    draws_actions: bool = False  # the actor is a distribution, whose mean acts
    has_value: bool = False  # there is a network of values in addition to those of action values
    # networks of action values follow slowly, for the right side of Bellman's equation
    has_targets: bool = True


ALGORITHMS = {
    "cql": AlgorithmRow(draws_actions=True),
    "cql_published": AlgorithmRow(reads_rewards=False, has_targets=False),
    "iql": AlgorithmRow(has_value=True),
}


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaOfflineRLConfig(PortedConfig):
    """An actor and a critic on one encoder of both cameras' images; actions lie in [-1, 1]."""

    masks_padding: ClassVar[bool] = True  # there is none: one action per sample
    reads_state: ClassVar[bool] = False  # the encoder of the paper's baselines has none
    observation_delta_indices: ClassVar[list[int]] = [0, 1]  # the frame and the next one
    inference_delta_indices: ClassVar[None] = None  # the frame itself
    action_delta_indices: ClassVar[list[int]] = [0]

    chunk_size: int = 1
    n_action_steps: int = 1

    algorithm: str = "iql"  # a name of `ALGORITHMS`
    # `dense`, `success` (1 in every step at which the success rule holds) or `sparse` (1 at the first of
    # them); None for an algorithm that reads none
    reward: str | None = "success"
    width: int = 64  # numbers that the encoder returns
    hidden: int = 256  # units of the two layers of actor and critics
    dropout: float = 0.0  # in these layers
    discount: float = 0.99
    target_rate: float = 0.005  # share by which the slow critics follow in each step (Polyak averaging)
    conservative_weight: float = 1.0  # of the conservative penalty of CQL
    n_sampled_actions: int = 10  # drawn for it from each of three distributions
    # of the squared distance between the actor's mean and the recorded action in CQL
    imitation_weight: float = 1.0
    expectile: float = 0.7  # of the values of IQL; 0.5 is the mean
    advantage_scale: float = 3.0  # by how much better actions count more in the imitation of IQL

    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 0.1
    # `scheduler_decay_steps`, `scheduler_decay_lr`: cosine after the warm-up
    scheduler_decay_steps: int = 50_000
    scheduler_decay_lr: float = 3e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("algorithm", ALGORITHMS)
        if self.reward is not None:
            self.check_choice("reward", REWARDS)
        if ALGORITHMS[self.algorithm].reads_rewards != (self.reward is not None):
            needed = "one of " + ", ".join(REWARDS) if self.reward is None else "null: it reads none"
            raise RecipeError(f"reward of '{self.algorithm}' is {self.reward}, expected {needed}.")
        require(self.chunk_size == 1, "chunk_size", self.chunk_size, "1: a critic judges single actions")
        check_bounds(self, BOUNDS)

    def fit_to_control_mode(self, mode: str) -> None:
        """Raise `RecipeError` unless the actions lie in [-1, 1], as those of the actor do."""
        if mode in ABSOLUTE_MODES:
            raise RecipeError(
                f"'{TYPE}' acts in [-1, 1], found a dataset of {mode}, whose actions are m and rad: record "
                f"with env.{CONTROL_MODE}={JOINT_DELTA_POS}, or another mode of deltas."
            )

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if not self.image_features or self.action_feature is None:
            raise ValueError(f"'{TYPE}' needs images and action")
        self.check_one_size()


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the places of a sample that pass through each."""
    encoder = encoder_stages(image_shape(config)[-1], 1, nature=True)
    return (*encoder, Stage(r"network\.targets\.", 0, HEAD))
