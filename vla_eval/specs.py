"""What an environment provides and a policy needs, as data that can be compared before the first step."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_eval.errors import SpecMismatchError, did_you_mean


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSpec:
    """One camera: (height_px, width_px, 3) uint8 RGB frames; `fov_rad` is the vertical field of view.

    None of an image that no camera took.
    """

    name: str
    height_px: int
    width_px: int
    fov_rad: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateSpec:
    """One proprioceptive vector: float32, one entry per name in `dims`; `unit` and `frame` in words."""

    name: str
    dims: tuple[str, ...]
    unit: str
    frame: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionSpec:
    """The action vector: one entry per name in `dims`, each within its bounds; beyond that it is clipped."""

    dims: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    control_mode: str
    gripper_open: float | None
    """Value of the last entry that opens the gripper, the opposite sign closes it; None without a gripper."""

    def clipped(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (…, A), float32, with each number within its bounds."""
        return np.clip(actions, self.low, self.high).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvSpec:
    """All that one task offers to a policy.

    `is_instructed`: whether its episodes have an instruction. `robot`: its name; None: the task has no robot.
    """

    task: str
    cameras: tuple[CameraSpec, ...]
    states: tuple[StateSpec, ...]
    action: ActionSpec
    horizon_steps: int
    control_hz: float
    is_instructed: bool = True
    robot: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySpec:
    """What a policy reads and what it returns."""

    name: str  # for messages
    # `last` if only the newest frame matters (the frames between two inferences are then not rendered),
    # `every` if the policy must see each control step
    reads: Literal["last", "every"]
    cameras: tuple[str, ...]  # the cameras it needs; empty means that nothing is ever rendered for it
    states: tuple[str, ...]  # the proprioceptive vectors it needs
    chunk_size: int  # how many actions one inference gives
    privileged: bool = False  # whether it reads the true state of the world (scripted controls only)
    reads_committed: bool = False  # whether its chunks join `ObservationWindow.committed`
    # whether it keeps something from one inference to the next, and `get_memory` and `set_memory` handle it
    has_memory: bool = False

    def is_given(self, step: int, next_inference_step: int, *, horizon_steps: int) -> bool:
        """Whether the policy will be given the observation at `step`: nothing after the last inference is."""
        if self.reads == "every":
            return max(step, next_inference_step) < horizon_steps
        return step == next_inference_step < horizon_steps


def check_compatible(policy: PolicySpec, env: EnvSpec) -> None:
    """Raise `SpecMismatchError` unless the environment provides all that the policy needs."""
    wanted = (
        ("camera", policy.cameras, [camera.name for camera in env.cameras]),
        ("state", policy.states, [state.name for state in env.states]),
    )
    for kind, needed, offered in wanted:
        for name in needed:
            if name not in offered:
                raise SpecMismatchError(
                    f"policy '{policy.name}' needs the {kind} '{name}', which {env.task} does not provide "
                    f"(it has: {', '.join(offered) or 'none'}).{did_you_mean(name, offered)} "
                    f"Correct the {kind} names in the policy's recipe."
                )
    if policy.chunk_size < 1:
        raise SpecMismatchError(f"policy '{policy.name}': chunk_size is {policy.chunk_size}, expected ≥ 1.")
