"""lerobot's configuration of the positive control; `docs/positive_control.md` explains it."""

from dataclasses import dataclass, field
from typing import Any, ClassVar  # lerobot is untyped

from lerobot.configs import PreTrainedConfig

from vla_eval.errors import check_names
from vla_eval.features import CAMERA_KEYS
from vla_eval.policies.memory.sizes import SPOTS, STATE
from vla_eval.policies.ported_config import PortedConfig

TYPE = "mikasa_memory"


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaMemoryConfig(PortedConfig):
    """A small policy with a memory, or its twin without one.

    A training sample is an episode from its beginning to a frame: `observation.*` at the `window_steps`
    frames up to it and, for the goal, at the episode's last frame; `action` at all of them and one chunk
    further. So any loop that follows `*_delta_indices` trains it.

    Nothing is normalised by statistics: positions in metres and actions in [-1, 1] need none, and rotation
    and gripper hardly vary in scripted demonstrations, where a deviation would scale up noise.

    Attributes:
        whole_episodes: `mikasa-vla finetune` lets every sample be a whole episode; its parts are in it.
        remembers: False for the twin, whose memory is reset at each step.
        window_steps: frames of history in a training sample; at least the longest episode, so that no
            memory begins in its middle. None: our `finetune` takes the dataset's longest.
        arm_cameras: the images whose camera is on the arm and moves with it.
        free_translation: a part of the translation does not depend on where the demonstration ends, for
            tasks that are more than a way to a place.
        channels, patch_px, heads, key, memory, hidden, longest_span_steps: see `NetworkSizes`.
        first_action_weight: share of a chunk's first action in the loss; the others share the rest.
        change_weight: a step counts 1 + so much per unit by which its action differs from the one before,
            which raises the moment of decision.
        waiting_share: a step whose action is that of the step before is used with this probability.
        goal_weight: of the auxiliary loss, in units of its variance: where the demonstration ends.
        doubt_weight: of the loss that teaches the policy how large its error will be.
        mix_colors: the three colours of an episode's images change places at random in training.
        optimizer_lr, optimizer_weight_decay, optimizer_grad_clip_norm, scheduler_warmup_steps,
            scheduler_decay_steps, scheduler_decay_lr: AdamW, warm-up, cosine.
    """

    whole_episodes: ClassVar[bool] = True

    remembers: bool = True
    window_steps: int | None = None
    chunk_size: int = 8
    n_action_steps: int = 8
    arm_cameras: list[str] = field(default_factory=lambda: [CAMERA_KEYS["hand_camera"]])

    channels: int = 32
    patch_px: int = 4
    heads: int = 8
    key: int = 16
    memory: int = 128
    hidden: int = 256
    longest_span_steps: float = 100.0
    free_translation: bool = False

    first_action_weight: float = 0.5
    change_weight: float = 3.0
    waiting_share: float = 0.3
    goal_weight: float = 1.0
    doubt_weight: float = 0.1
    mix_colors: bool = False

    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 50
    scheduler_decay_steps: int = 2000
    scheduler_decay_lr: float = 4e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window_steps is not None and self.window_steps < 1:
            raise ValueError(f"window_steps is {self.window_steps}, expected a number ≥ 1 or null")
        if self.patch_px < 1 or self.patch_px % SPOTS:
            raise ValueError(
                f"patch_px is {self.patch_px}, expected a multiple of {SPOTS}: so many spots has an edge"
            )
        for name in ("first_action_weight", "waiting_share"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a number in (0, 1]")

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        if not self.image_features or self.robot_state_feature is None or self.action_feature is None:
            raise ValueError(f"'{TYPE}' needs images, observation.state and action")
        if self.robot_state_feature.shape != (STATE,):
            raise ValueError(
                f"'{TYPE}' needs the state 'eef' of {STATE} numbers, found {self.robot_state_feature.shape}: "
                "record with state: eef"
            )
        where = f"policy.arm_cameras ({TYPE}; those whose camera is on the arm, [] if none is)"
        check_names("image", self.arm_cameras, self.image_features, where=where)
        shapes = {tuple(feature.shape) for feature in self.image_features.values()}
        if len(shapes) != 1:
            raise ValueError(f"'{TYPE}' needs images of one size, found {sorted(shapes)}")
        _, height_px, width_px = next(iter(shapes))
        if height_px != width_px or height_px % self.patch_px:
            raise ValueError(
                f"'{TYPE}' needs square images whose edge is a multiple of patch_px ({self.patch_px}), "
                f"found {height_px}×{width_px}"
            )

    @property
    def n_window_steps(self) -> int:
        """`window_steps`, once it is known."""
        if self.window_steps is None:
            raise ValueError(
                f"'{TYPE}': window_steps is not set: give it the length in frames of the dataset's longest "
                "episode (`mikasa-vla finetune` does)"
            )
        return self.window_steps

    @property
    def observation_delta_indices(self) -> list[int]:
        """The window up to the frame, and a frame beyond every episode's end: lerobot takes its last one."""
        return [*range(1 - self.n_window_steps, 1), self.n_window_steps]

    @property
    def inference_delta_indices(self) -> None:
        """Only the frame itself: the policy keeps its own history."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """A chunk for each frame of the window."""
        return list(range(1 - self.n_window_steps, self.chunk_size))

    def get_scheduler_preset(self) -> Any:
        """Return lerobot's configuration of the schedule."""
        return self.cosine(decay_steps=self.scheduler_decay_steps, decay_lr=self.scheduler_decay_lr)
