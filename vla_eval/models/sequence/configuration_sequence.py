"""lerobot's configuration of the plain policies that remember; `docs/sequence_policies.md` explains them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args  # lerobot is untyped

import numpy as np
from lerobot.configs import PreTrainedConfig
from numpy.typing import NDArray

from vla_eval.control_modes import TRANSLATING_MODES
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.features import REWARD_KEY, SUCCESS_KEY, RewardKind
from vla_eval.models.cores.sizes import BELOW_ONE, CORES, check_core
from vla_eval.models.episodes.config import EpisodeConfig
from vla_eval.models.sequence.sizes import ENCODERS, HEADS, TOKENS, encoder_stages
from vla_eval.models.shared.stages import EPISODE_STEPS, HEAD, LANGUAGE, Stage, Stages, image_shape
from vla_eval.strict.bounds import check_bounds, require

TYPE = "mikasa_sequence"


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaSequenceConfig(EpisodeConfig):
    """A plain network: an encoder of images, a core over time, a head that predicts a chunk."""

    core: str = "gru"  # what is kept from step to step, a name of `CORES`
    # sizes of the core that differ from its row there
    core_options: dict[str, Any] = field(default_factory=dict)
    encoder: str = "keypoints"  # of images, a name of `ENCODERS`
    # a name of `HEADS`. `gated` reads the observation and the core's answer; `linear`, of the sequence
    # models' papers, reads the answer alone and bounds actions by tanh.
    # `flow` makes the chunk by flow matching from what `gated` reads.
    head: str = "gated"
    num_inference_steps: int = 10  # of the integration from noise to actions, with head=flow
    # in training, up to so many first actions of a chunk are given (drawn), and only the rest is learned: for
    # chunking.mode=prefix. Half of those given while the arm has only waited are of waiting on.
    prefix_steps: int = 0
    # the goal is where the motion under way ends, or the next one, not the demonstration; each motion begins
    # with a decision. For tasks in which several things are touched in turn: `docs/many_tasks.md`.
    goal_of_each_motion: bool = False
    tokens: str = "step"  # of a step, a name of `TOKENS`
    state_in_token: bool = True  # the token of an observation has the state in it, not only the images
    reward: str | None = None  # whose return to go is a token, a `RewardKind`. None: no token needs one.
    # the return to go at inference, the same at every step. None: 1 for sparse rewards; for others the
    # highest return of the dataset's episodes.
    target_return: float | None = None
    width: int = 256  # units of a token, of the core and of the head
    layers: int = 1
    heads: int = 4  # of its attention, where it has any
    # the steps, the newest among them, that a layer of a transformer sees; of cores that read an episode
    # in segments, the steps of one
    context_steps: int = 200
    dropout: float = 0.0

    optimizer_lr: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("core", CORES)
        self.check_choice("encoder", ENCODERS)
        self.check_choice("head", HEADS)
        self.check_choice("tokens", TOKENS)
        counts = ("width", "layers", "heads", "context_steps", "num_inference_steps")
        check_bounds(self, {**dict.fromkeys(counts, (1, math.inf)), "dropout": (0, BELOW_ONE)})
        check_core(self.core, width=self.width, heads=self.heads, given=self.core_options)
        self._check_head()
        kinds = get_args(RewardKind)
        if self.reads_returns and self.reward not in kinds:
            raise RecipeError(
                f"reward is {self.reward}, expected {' or '.join(kinds)}: tokens={self.tokens} reads the "
                "return to go"
            )
        if not self.reads_returns and (self.reward is not None or self.target_return is not None):
            raise RecipeError(
                f"reward and target_return belong to tokens=return_observation[_action], found {self.tokens}"
            )
        if self.reward == "sparse" and self.target_return is None:
            self.target_return = 1.0

    @property
    def reads_returns(self) -> bool:
        """Whether the return to go is a token."""
        return self.tokens != "step"

    @property
    def reads_actions(self) -> bool:
        """Whether the action of a step is a token."""
        return self.tokens == "return_observation_action"

    @property
    def tokens_per_step(self) -> int:
        """Tokens of a step."""
        return TOKENS[self.tokens]

    @property
    def reward_delta_indices(self) -> list[int] | None:
        """The steps of the window, if the return to go is read."""
        return list(range(1 - self.n_window_steps, 1)) if self.reads_returns else None

    @property
    def return_at_inference(self) -> float:
        """`target_return`, once it is known."""
        if self.target_return is None:
            raise ValueError(f"'{TYPE}': target_return is not set (`mikasa-vla finetune` sets it)")
        return self.target_return

    def fit_to_control_mode(self, mode: str) -> None:
        """Raise `SpecMismatchError` for actions that do not say where a motion begins."""
        if self.goal_of_each_motion and mode not in TRANSLATING_MODES:
            raise SpecMismatchError(
                "goal_of_each_motion is true: expected actions that translate the tool "
                f"({', '.join(TRANSLATING_MODES)}), found those of {mode}. Set policy.goal_of_each_motion to "
                "false."
            )

    def fit_to_rewards(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Take the target return from a dataset's frames, by field (N,), where it is not given."""
        key = REWARD_KEY if self.reward == "dense" else SUCCESS_KEY
        if self.reward is None or self.target_return is not None or key not in columns:
            return
        _, episodes = np.unique(columns["episode_index"], return_inverse=True)
        sums = np.bincount(episodes.reshape(-1), weights=columns[key].reshape(-1).astype(np.float64))
        self.target_return = float(sums.max())

    @property
    def noise_shape(self) -> tuple[int, int] | None:
        """Shape of the noise that a chunk is made from; None if it is made of none."""
        return (self.chunk_size, int(self.action_feature.shape[0])) if self.head == "flow" else None

    def _check_head(self) -> None:
        require(
            0 <= self.prefix_steps < self.chunk_size,
            "prefix_steps",
            self.prefix_steps,
            f"0 to {self.chunk_size - 1}, less than chunk_size",
        )
        require(
            self.head != "linear" or not self.prefix_steps,
            "prefix_steps",
            self.prefix_steps,
            "0 with head=linear",
        )
        require(
            self.head != "flow" or not self.reads_actions,
            "head",
            self.head,
            f"another with tokens={self.tokens}",
        )


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the places and steps of a sample that pass through each."""
    n_steps = config.window_steps or EPISODE_STEPS
    # Decision Transformer reads its window again at every step.
    n_reads = config.context_steps if config.core == "decision_transformer" else 1
    nature = config.encoder.startswith("nature")
    return (
        *encoder_stages(image_shape(config)[-1], n_steps, nature=nature),
        Stage(r"network\.core\.", n_steps * config.tokens_per_step * n_reads, LANGUAGE),
        Stage(r"network\.sentence\.", 1, HEAD),
        Stage(r"network\.", n_steps, HEAD),
    )
