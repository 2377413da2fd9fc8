"""What scripted controls share: spec, random generators, how to hold still, and other control modes."""

import functools
import importlib
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import EE_DELTA_POS, EE_DELTA_POSE, action_spec
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.oracles.arm_model import gripper_command
from vla_eval.oracles.joint_motion import joint_rows
from vla_eval.oracles.translation import translated
from vla_eval.policies.context import PolicyContext
from vla_eval.robots.arm import Arm
from vla_eval.robots.find import robot_named
from vla_eval.seeding import Stream, generator
from vla_eval.specs import PolicySpec
from vla_eval.task_state import PrivilegedState
from vla_eval.tasks.catalog import task_spec

JOINT_STATES = ("qpos", "qvel")


def hold_rows(gripper_width_m: float, n_actions: int, n_dims: int = 7) -> NDArray[np.float32]:
    """Return (n_actions, n_dims) that move nothing and keep the fingers `gripper_width_m` apart."""
    rows = np.zeros((n_actions, n_dims), dtype=np.float32)
    rows[:, -1] = gripper_command(gripper_width_m / 2)
    return rows


def check_has(condition: bool, context: PolicyContext, does: str, lacks: str) -> None:
    """Raise `SpecMismatchError` unless the task has what the policy needs."""
    if not condition:
        raise SpecMismatchError(
            f"policy '{context.name}' {does}; {context.env.task} {lacks}. Leave this task out for this "
            "policy."
        )


def task_expert(context: PolicyContext) -> Any:  # Any: each family's experts have a protocol of their own
    """Return the scripted expert of the context's task; raise if it has none, as half of the official 90."""
    row = task_spec(context.env.task)
    module, _, name = row.oracle.partition(":")
    if not module or row.is_base:
        raise SpecMismatchError(
            f"policy '{context.name}' needs a scripted expert, and {context.env.task} has none. Leave this "
            "task out for this policy; `random` runs on every task."
        )
    return getattr(importlib.import_module(module), name)


def arm_of(context: PolicyContext) -> Arm:
    """Return the robot of the context's environment; raise `SpecMismatchError` if it has none."""
    robot = context.env.robot
    check_has(robot is not None, context, "moves a robot", "has none")
    return robot_named(str(robot))


class ScriptedPolicy:
    """What all controls share: their spec, and one random generator per running episode."""

    privileged = False
    states: tuple[str, ...] = ()

    def __init__(self, context: PolicyContext) -> None:
        """Plan just as many actions as one inference has to give."""
        self._context = context
        self._n_actions = context.chunking.planned_rows
        self._n_dims = len(context.env.action.dims)
        self._rng: dict[int, np.random.Generator] = {}
        self.spec = PolicySpec(
            name=context.name,
            reads="last",
            cameras=(),
            states=self.states,
            chunk_size=self._n_actions,
            privileged=self.privileged,
        )

    @property
    def arm(self) -> Arm:
        """The robot of the environment."""
        return arm_of(self._context)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Seed each episode's generator by its task, seed and run."""
        for episode in episodes:
            task_key = zlib.crc32(episode.task.encode())  # else luck would be the same luck in every task
            self._rng[episode.slot] = generator(episode.seed, Stream.POLICY, task_key, episode.run)

    def forget(self, slots: Sequence[int]) -> None:
        """Release the generators of these slots."""
        for slot in slots:
            self._rng.pop(slot, None)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan a chunk."""
        raise NotImplementedError

    def privileged_state(self, window: ObservationWindow) -> PrivilegedState:
        """Return the true state of the world at the last observation; raise if the environment has none."""
        state = window.last.privileged
        if not isinstance(state, PrivilegedState):
            raise SpecMismatchError(
                f"policy '{self.spec.name}' reads the true state of the world, but the observations of "
                f"{self._context.env.task} carry none. Make the environment with privileged=True."
            )
        return state


class TranslatedPolicy:
    """A scripted control whose chunks, planned in `pd_ee_delta_pose`, are translated to another mode."""

    def __init__(self, planner: ScriptedPolicy, arm: Arm, mode: str) -> None:
        self._planner = planner
        self._arm = arm
        self._mode = mode
        states = tuple(dict.fromkeys((*planner.spec.states, *JOINT_STATES)))
        self.spec = replace(planner.spec, states=states)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes."""
        self._planner.reset(episodes)

    def forget(self, slots: Sequence[int]) -> None:
        """Release what the planner knows of these slots."""
        self._planner.forget(slots)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan a chunk, and translate it."""
        state = window.last.state
        planned = self._planner.act(window).actions
        qpos, qvel = (state[name].astype(float) for name in JOINT_STATES)
        if self._arm.chain is not None:
            return ActionChunk(actions=joint_rows(planned, self._arm, self._mode, qpos, qvel))
        return ActionChunk(actions=translated(planned, self._mode, qpos, qvel))


def in_any_control_mode(
    make: Callable[[PolicyContext], ScriptedPolicy],
) -> Callable[[PolicyContext], ScriptedPolicy | TranslatedPolicy]:
    """Make controls for every control mode; refuse one without rotation where the expert turns the wrist."""

    @functools.wraps(make)
    def made(context: PolicyContext) -> ScriptedPolicy | TranslatedPolicy:
        mode = context.env.action.control_mode
        if mode == EE_DELTA_POSE:
            return make(context)
        arm = arm_of(context)
        if mode not in arm.actions:
            raise SpecMismatchError(
                f"policy '{context.name}' plans with the model of {arm.name}: expected a control mode of its "
                f"joints ({', '.join(arm.actions)}), found {mode}. Choose one of these."
            )
        planner = make(replace(context, env=replace(context.env, action=action_spec(EE_DELTA_POSE))))
        if mode == EE_DELTA_POS and planner.privileged and task_spec(context.env.task).turns_wrist:
            raise SpecMismatchError(
                f"policy '{context.name}': the expert of {context.env.task} turns the wrist, and the control "
                f"mode {mode} has no rotation. Choose another env.control_mode, or leave this task out."
            )
        return TranslatedPolicy(planner, arm, mode)

    return made
