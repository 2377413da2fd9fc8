"""What a task reports about its episode: its status, for the record; the true state, for scripted controls.

Knows nothing of simulators. A learned policy is given none of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Phase = Literal["cue", "delay", "response"]
"""Part of an episode: the cue is shown; nothing to remember it by is in view; the answer is due."""
PHASES: tuple[Phase, ...] = get_args(Phase)
"""In their order: index of a phase in tensors -> its name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskStatus:
    """What the task says of the episode so far; reading it changes nothing."""

    phase: Phase | None  # the phase at this step; None where the environment does not show it
    success: bool  # the success rule holds at this very step
    is_over: bool = False  # the rules of the task end the episode here, won or not
    has_success: bool = True  # whether the task has a success rule
    fail: bool = False  # the episode is lost for good (`strict_choice`, first wrong candidate)
    n_candidates: int = 0  # how many candidates there are; 0 for a task without candidates
    # how many different wrong candidates have been touched in the response phase
    n_wrong_choices: int = 0
    # the candidates that it is right to touch first; empty without candidates
    right_first_choices: tuple[int, ...] = ()
    # success rate of a perfect arm that ignores the cue, with the arguments of this environment; None
    # where it has to be measured
    chance_success: float | None = None
    # names of the candidates, in their order, where they are not those of the task; else empty
    candidate_names: tuple[str, ...] = ()
    # the place at which each candidate lies when the response phase begins, in candidate order: 0 is the
    # rightmost as the robot sees it (-y). Empty where places are not known.
    candidate_places: tuple[int, ...] = ()
    # the right candidates, in the order shown; None where it is not said
    right_candidates: tuple[int, ...] | None = None
    # those touched so far in the response phase, in the order of first touch; None where it is not said
    touched_candidates: tuple[int, ...] | None = None
    # how far the object of the task is turned from its first orientation; None without one
    turned_rad: float | None = None

    @property
    def target(self) -> int | None:
        """The right candidate; None for a task without candidates or with several right ones."""
        return _only_one(self.right_candidates)

    @property
    def first_choice(self) -> int | None:
        """The candidate that was touched first, if any."""
        return self.touched_candidates[0] if self.touched_candidates else None


@dataclass(frozen=True, slots=True, kw_only=True)
class PrivilegedState:
    """The world as it truly is, for scripted controls. Never given to a learned policy."""

    phase: Phase  # the phase that holds at this step
    response_step: int  # the step at which the response phase begins (0 for a task without phases)
    tcp_position_m: NDArray[np.float64]  # (3,) tool centre point, world frame
    tcp_velocity_m_s: NDArray[np.float64]  # (3,) its linear velocity, world frame
    gripper_width_m: float  # gap between the fingers, 0 to 0.08
    # (N, 3) where each candidate is (or, before the response phase, will be), world frame, in candidate
    # order; (0, 3) for a task without candidates
    candidate_positions_m: NDArray[np.float64]
    # indices of all right candidates, in the order shown; empty without candidates
    right_candidates: tuple[int, ...] = ()
    shown_candidates: tuple[int, ...] = ()  # those of them whose cue is in view at this step
    in_order: bool = False  # whether several right candidates must be touched in that order
    # indices of those touched so far, in the order of first touch
    touched_candidates: tuple[int, ...] = ()
    # bodies and places by name, as the task names them: `ball`, `goal` …
    bodies: Mapping[str, "BodyState"] = field(default_factory=dict)
    # how far the gripper is turned about world z; 0 with the fingers in a row along y
    tcp_yaw_rad: float = 0.0

    @property
    def target(self) -> int | None:
        """The right candidate; None for a task without candidates or with several right ones."""
        return _only_one(self.right_candidates)


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenState:
    """What is hidden of an episode without a robot, by name; for scripted controls alone."""

    values: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyState:
    """Position (m) and linear velocity (m/s) of a body, each (3,), and its yaw, in the world frame."""

    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]
    yaw_rad: float = 0.0


def _only_one(candidates: tuple[int, ...] | None) -> int | None:
    return candidates[0] if candidates is not None and len(candidates) == 1 else None
