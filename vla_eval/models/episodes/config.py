"""What configurations of our policies that train on episodes share. Knows no network."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar  # lerobot is untyped

from vla_eval.features import STATE_NAMES
from vla_eval.models.shared.ported_config import PortedConfig
from vla_eval.strict.bounds import check_bounds, require

STATE = len(STATE_NAMES["eef"])  # position, two columns of a rotation matrix, gripper
POSITION_SCALE = 5.0  # metres of the workspace to numbers of about 1
SPACE = 3  # numbers of a position, and of the translation with which an action begins
SENTENCES = ("none", "words")
"""`words`: which words are in it, see `sentence.SentenceEncoder`."""
BOUNDS: Mapping[str, tuple[float, float]] = {
    "window_steps": (1, math.inf),
    **dict.fromkeys(("late_steps", "erase_warmup_episodes", "shift_px"), (0, math.inf)),
    **dict.fromkeys(("decision_share", "exchange_share", "erase_share"), (0, 1)),
}
NEEDS = {
    "erase_share": "decision_share",
    "erase_warmup_episodes": "erase_share",
    "waits_beyond_decision": "masks_beyond_decision",
}
"""Field -> the field without which it does nothing."""


@dataclass
class EpisodeConfig(PortedConfig):
    """A policy that is trained on episodes from their beginning.

    A training sample is an episode from its beginning to a frame: `observation.*` at the `window_steps`
    frames up to it and, for the goal, at the episode's last frame; `action` at all of them and one chunk
    further. So any loop that follows `*_delta_indices` trains it.

    Nothing is normalised by statistics: positions in metres and actions in [-1, 1] need none, and rotation
    and gripper hardly vary in scripted demonstrations. `docs/general_memory.md` explains the training.
    """

    # `mikasa-vla finetune` lets every sample be a whole episode; its parts are in it
    whole_episodes: ClassVar[bool] = True
    # it hands over images as bytes, so that numbers are made only of the frames that are used
    takes_bytes: ClassVar[bool] = True
    # actions beyond an episode's end count nothing, see `episode_samples`
    masks_padding: ClassVar[bool] = True
    inference_delta_indices: ClassVar[None] = None  # the frame itself: the policy keeps its own history

    # frames of history in a training sample; at least the longest episode, so that no memory begins in
    # its middle. None: our `finetune` takes the dataset's longest.
    window_steps: int | None = None

    # share of a chunk's first action in the loss; the others share the rest
    first_action_weight: float = 0.5
    # a step counts 1 + so much per unit by which its action differs from the one before
    change_weight: float = 3.0
    # a step whose action is that of the step before is used with this probability
    waiting_share: float = 0.3
    # of such steps one in each 1 / `waiting_share` is used, from a random one on, instead of each by itself:
    # so that a cue as long as this, while the arm waits, is always seen
    waits_evenly: bool = False
    # any other step that is not a decision, with this one: for a training of choices, most of whose frames
    # would be of motions between them. The first step is always used.
    moving_share: float = 1.0
    # share of the episodes of a training batch that end at a decision, one of the episode's at random: a
    # step at which the arm begins to move after it waited
    decision_share: float = 0.0
    # actions of a frame's chunk from the next decision on do not count, nor does the goal before the
    # first decision: what they depend on has not been seen yet
    masks_beyond_decision: bool = False
    # with `masks_beyond_decision`, those actions are replaced by the one before the decision: to wait
    waits_beyond_decision: bool = False
    # the frame of a decision is shown up to so many times again in training, at random; all of them
    # together count as much as one
    late_steps: int = 0
    # of the auxiliary loss, in units of its variance: where the demonstration ends
    goal_weight: float = 1.0
    mix_colors: bool = False  # the colours of an episode's images change places at random in training
    # share of the episodes in which the things that appear exchange their colours, alike in all frames,
    # see `things`
    exchange_share: float = 0.0
    # of those that end at their first decision, the share in which some of the things that appear at it,
    # but of no colour that was shown before, are erased
    erase_share: float = 0.0
    # in so many training samples of a process, the number of wrong things that may stay where some are
    # erased grows from one to all, as the square of the samples so far. 0: all may stay at once.
    erase_warmup_episodes: int = 0
    # the images of an episode are moved by up to so many pixels in each direction in training, see
    # `docs/general_memory.md`
    shift_px: int = 0
    sentence: str = "none"  # what is read of the instruction, a name of `SENTENCES`

    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    scheduler_warmup_steps: int = 50
    # `scheduler_decay_steps`, `scheduler_decay_lr`: cosine after the warm-up
    scheduler_decay_steps: int = 2000
    scheduler_decay_lr: float = 4e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_choice("sentence", SENTENCES)
        check_bounds(self, BOUNDS)
        for name in ("first_action_weight", "waiting_share", "moving_share"):
            require(0 < getattr(self, name) <= 1, name, getattr(self, name), "a number in (0, 1]")
        for name, needed in NEEDS.items():
            met = bool(getattr(self, needed)) or not getattr(self, name)
            require(met, needed, getattr(self, needed), f"it to be set: {name} does nothing without it")

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if not self.image_features or self.robot_state_feature is None or self.action_feature is None:
            raise ValueError(f"'{self.type}' needs images, observation.state and action")
        if self.robot_state_feature.shape != (STATE,):
            raise ValueError(
                f"'{self.type}' needs the state 'eef' of {STATE} numbers, found "
                f"{self.robot_state_feature.shape}: record with state: eef"
            )
        self.check_one_size()

    @property
    def reads_sentence(self) -> bool:
        """Whether it acts by the instruction."""
        return self.sentence != "none"

    @property
    def n_window_steps(self) -> int:
        """`window_steps`, once it is known."""
        if self.window_steps is None:
            raise ValueError(
                f"'{self.type}': window_steps is not set: give it the length in frames of the dataset's "
                "longest episode (`mikasa-vla finetune` does)"
            )
        return self.window_steps

    @property
    def observation_delta_indices(self) -> list[int]:
        """The window up to the frame, and a frame beyond every episode's end: lerobot takes its last one."""
        return [*range(1 - self.n_window_steps, 1), self.n_window_steps]

    @property
    def action_delta_indices(self) -> list[int]:
        """A chunk for each frame of the window."""
        return list(range(1 - self.n_window_steps, self.chunk_size))
