"""Scripted controls in every control mode: they plan in `pd_ee_delta_pose`, and the plan is translated."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

from vla_eval.control_modes import EE_DELTA_POS, EE_DELTA_POSE, action_spec
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.oracles.translation import translated
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.base import ScriptedPolicy
from vla_eval.tasks.catalog import task_spec

JOINT_STATES = ("qpos", "qvel")


class TranslatedPolicy:
    """A scripted control whose chunks, planned in `pd_ee_delta_pose`, are translated to another mode."""

    def __init__(self, planner: ScriptedPolicy, mode: str) -> None:
        self._planner = planner
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
        return ActionChunk(actions=translated(planned, self._mode, qpos, qvel))


ScriptedMaker = Callable[[PolicyContext], ScriptedPolicy]


def in_any_control_mode(make: ScriptedMaker) -> Callable[[PolicyContext], ScriptedPolicy | TranslatedPolicy]:
    """Make controls for every control mode; refuse one without rotation where the expert turns the wrist."""

    @functools.wraps(make)
    def made(context: PolicyContext) -> ScriptedPolicy | TranslatedPolicy:
        mode = context.env.action.control_mode
        if mode == EE_DELTA_POSE:
            return make(context)
        planner = make(replace(context, env=replace(context.env, action=action_spec(EE_DELTA_POSE))))
        if mode == EE_DELTA_POS and planner.privileged and task_spec(context.env.task).turns_wrist:
            raise SpecMismatchError(
                f"policy '{context.name}': the expert of {context.env.task} turns the wrist, and the control "
                f"mode {mode} has no rotation. Choose another env.control_mode, or leave this task out."
            )
        return TranslatedPolicy(planner, mode)

    return made
