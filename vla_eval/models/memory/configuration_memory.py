"""lerobot's configuration of the positive control; `docs/positive_control.md` explains it."""

from dataclasses import dataclass, field
from typing import Any  # lerobot is untyped

from lerobot.configs import PreTrainedConfig

from vla_eval.control_modes import CONTROL_MODES, JOINT_POS, TRANSLATING_MODES
from vla_eval.errors import RecipeError, SpecMismatchError, check_names
from vla_eval.features import CAMERA_KEYS
from vla_eval.models.episodes.config import EpisodeConfig
from vla_eval.models.memory.sizes import SPOTS
from vla_eval.models.shared.stages import EPISODE_STEPS, HEAD, VISION, Stage, Stages, image_shape

TYPE = "mikasa_memory"
LEARNED_MODES = (*TRANSLATING_MODES, JOINT_POS)


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaMemoryConfig(EpisodeConfig):
    """A small policy with a memory, or its twin without one."""

    remembers: bool = True  # False for the twin, whose memory is reset at each step
    # the images whose camera is on the arm and moves with it
    arm_cameras: list[str] = field(default_factory=lambda: [CAMERA_KEYS["hand_camera"]])

    # `channels`, `patch_px`, `heads`, `key`, `memory`, `hidden`, `longest_span_steps`: see
    # `NetworkSizes`
    channels: int = 32
    patch_px: int = 4
    heads: int = 8
    key: int = 16
    memory: int = 128
    hidden: int = 256
    longest_span_steps: float = 100.0
    # a part of the translation does not depend on where the demonstration ends, for tasks that are more
    # than a way to a place
    free_translation: bool = False
    # episodes in which the arm begins to move more than once do not teach the goal: theirs is that of
    # the last motion, and wrong until then. On ten tasks that kept the goal from being learned at all.
    goal_of_one_motion: bool = False
    # actions are those of `pd_joint_pos`; `finetune` sets it by the dataset's control mode
    joint_targets: bool = False

    doubt_weight: float = 0.1  # of the loss that teaches the policy how large its error will be

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.patch_px < 1 or self.patch_px % SPOTS:
            raise RecipeError(
                f"patch_px is {self.patch_px}, expected a multiple of {SPOTS}: so many spots has an edge"
            )

    def fit_to_control_mode(self, mode: str) -> None:
        """Take the control mode of a dataset; raise `SpecMismatchError` for actions that are not learned."""
        if mode not in LEARNED_MODES:
            raise SpecMismatchError(
                f"'{TYPE}' learns actions of {', '.join(LEARNED_MODES)}; the dataset's are for {mode}. "
                f"Convert it: mikasa-vla dataset convert DATASET --control-mode {JOINT_POS} --out OUT."
            )
        self.joint_targets = mode == JOINT_POS
        if self.joint_targets and self.goal_of_one_motion:
            raise SpecMismatchError(
                "goal_of_one_motion is true: expected actions that translate the tool, found those of "
                f"{mode}. Set policy.goal_of_one_motion to false."
            )

    def validate_features(self) -> None:
        """Check the fields of the dataset."""
        super().validate_features()
        n_numbers = int(self.action_feature.shape[0])
        if self.joint_targets != (n_numbers == len(CONTROL_MODES[JOINT_POS].dims)):
            raise ValueError(
                f"'{TYPE}' with joint_targets: {self.joint_targets} does not fit actions of {n_numbers} "
                f"numbers; it is for those of {JOINT_POS}"
            )
        where = f"policy.arm_cameras ({TYPE}; those whose camera is on the arm, [] if none is)"
        check_names("image", self.arm_cameras, self.image_features, where=where)
        _, height_px, width_px = next(iter(self.image_features.values())).shape
        if height_px != width_px or height_px % self.patch_px:
            raise ValueError(
                f"'{TYPE}' needs square images whose edge is a multiple of patch_px ({self.patch_px}), "
                f"found {height_px}×{width_px}"
            )


def network_stages(config: Any) -> Stages:
    """Return the parts of the network, and the places and steps of a sample that pass through each."""
    n_steps = config.window_steps or EPISODE_STEPS
    n_places = (image_shape(config)[-1] // config.patch_px) ** 2
    return (Stage(r"network\.(eyes|keys)\.", n_steps * n_places, VISION), Stage(r"network\.", n_steps, HEAD))
