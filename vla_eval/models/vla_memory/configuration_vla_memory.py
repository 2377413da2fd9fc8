"""lerobot's configurations of SmolVLA, π0 and π0.5 with memory; `docs/vla_memory.md` explains them."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar  # lerobot is untyped

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from vla_eval.errors import RecipeError, check_names
from vla_eval.features import CAMERA_KEYS
from vla_eval.models.shared.earlier_frames import SampleMemory, Segments, place_fields
from vla_eval.models.shared.frame_choice import FrameChoice
from vla_eval.strict.bounds import MAX_STEPS, check_bounds

MAX_PLACES, MAX_TOKENS = 64, 4096  # each place is an image of the prefix, up to 256 tokens
BOUNDS = {
    "memory_places": (0, MAX_PLACES),
    "memory_stride": (1, MAX_STEPS),
    "memory_tokens": (0, MAX_TOKENS),
    "token_stride": (1, MAX_STEPS),
    "token_segments": (1, MAX_STEPS),
}


@dataclass
class VlaMemoryConfig:
    """Memory of a VLA that reads one frame: earlier frames as further images, and recurrent tokens."""

    masks_padding: ClassVar[bool] = False
    observation_delta_indices: ClassVar[None] = None  # the frame itself: earlier ones come as fields

    memory_places: int = 0  # further images of each camera at most; 0: none
    memory_rule: str = "last"  # which frames they are, a name of `frame_choice.RULES`
    memory_stride: int = 8  # of the rule `last`: control steps between them
    # of the rule `keyframes`: a smaller change of the image is not an event
    memory_novelty: float = 0.08
    # of which cameras, by the dataset's names; the rule looks at the first
    memory_cameras: list[str] = field(default_factory=lambda: [next(iter(CAMERA_KEYS.values()))])
    memory_tokens: int = 0  # that are carried from inference to inference; 0: none
    token_stride: int = 8  # control steps between two writings of them, the first frame being one
    # writings through which a loss is propagated back, the frame itself among them
    token_segments: int = 8
    # length of the longest episode in training, with tokens; our `finetune` sets it
    window_steps: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()  # type: ignore[misc]  # of lerobot's configuration, which comes second
        check_bounds(self, BOUNDS, prefix="policy.")
        self.frame_choice()  # checks its numbers
        if not self.memory_cameras or len(set(self.memory_cameras)) < len(self.memory_cameras):
            raise RecipeError(f"policy.memory_cameras is {self.memory_cameras}, expected each camera once")
        check_names("camera", self.memory_cameras, CAMERA_KEYS.values(), where="policy.memory_cameras")
        if self.memory_tokens and getattr(self, "compile_model", False):
            raise RecipeError(
                "policy.memory_tokens: a compiled model takes no tokens. Set compile_model: false"
            )

    def frame_choice(self) -> FrameChoice | None:
        """Return how earlier frames are chosen; None if none are shown."""
        choice = FrameChoice(
            rule=self.memory_rule,
            n_places=max(1, self.memory_places),
            stride=self.memory_stride,
            least_novelty=self.memory_novelty,
        )
        return choice if self.memory_places else None

    @property
    def memory_fields(self) -> tuple[str, ...]:
        """Fields of the images of earlier frames, which no camera has."""
        return place_fields(self.memory_cameras, self.memory_places)

    @property
    def sample_memory(self) -> SampleMemory | None:
        """What a training sample has in addition to its own frame; None: nothing."""
        choice = self.frame_choice()
        segments = self._segments() if self.memory_tokens else None
        if choice is None and segments is None:
            return None
        return SampleMemory(choice=choice, cameras=tuple(self.memory_cameras), segments=segments)

    def n_passes(self, window_steps: int) -> tuple[int, int]:
        """Return how many frames of a sample pass through the model: without a gradient, and with one.

        `window_steps`: of the longest episode, if the configuration does not say it.
        """
        if not self.memory_tokens:
            return 0, 1
        n_segments = _n_segments(self.window_steps or window_steps, self.token_stride)
        n_with = min(n_segments, self.token_segments)
        return n_segments - n_with, n_with

    def _segments(self) -> Segments:
        if self.window_steps is None:
            raise ValueError(
                "window_steps is not set: give it the length in frames of the dataset's longest episode "
                "(`mikasa-vla finetune` does)"
            )
        return Segments(
            stride=self.token_stride, n_segments=_n_segments(self.window_steps, self.token_stride)
        )

    def validate_features(self) -> None:
        """Add the fields of earlier frames to lerobot's own; they come last, with the size of the others."""
        super().validate_features()  # type: ignore[misc]
        config: Any = self
        images = [feature for key, feature in config.image_features.items() if key not in self.memory_fields]
        for key in self.memory_fields:
            config.input_features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=images[0].shape)


def _n_segments(window_steps: int, stride: int) -> int:
    return 1 + math.ceil((window_steps - 1) / stride)


@PreTrainedConfig.register_subclass("mikasa_smolvla")
@dataclass
class MikasaSmolVLAConfig(VlaMemoryConfig, SmolVLAConfig):  # type: ignore[misc]  # lerobot is untyped
    """SmolVLA with memory."""

    masks_padding: ClassVar[bool] = True


@PreTrainedConfig.register_subclass("mikasa_pi0")
@dataclass
class MikasaPI0Config(VlaMemoryConfig, PI0Config):  # type: ignore[misc]  # lerobot is untyped
    """π0 with memory."""


@PreTrainedConfig.register_subclass("mikasa_pi05")
@dataclass
class MikasaPI05Config(VlaMemoryConfig, PI05Config):  # type: ignore[misc]  # lerobot is untyped
    """π0.5 with memory."""
