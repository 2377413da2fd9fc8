"""Who leads the arm in a demonstration: LeRobot's teleoperator, or a script beside the simulated arm.

To the loop a leader is a policy: its actions are positions of the motors, one per control step.
"""

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.files import load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.real_robot import RobotSettings
from vla_eval.control_modes import MOTORS
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow, Policy
from vla_eval.envs.robot.operators import Operator
from vla_eval.envs.robot.robot_env import RobotEnv, Station
from vla_eval.envs.robot.teleop import TeleopLink
from vla_eval.envs.robot.units import Units
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.specs import PolicySpec
from vla_eval.tasks.real_stages import COLORS, Stage, Trial

ONE_BY_ONE = ChunkingSpec(n_action_steps=1)
EXPERT = "oracle"


class Leader(Protocol):
    """What leads an arm."""

    def policy(self, station: Station, stage: Stage) -> Policy:
        """Return it as the policy of a stage."""

    def about(self) -> list[str]:
        """Return what a person has to check of it before the arm moves; errors as its device."""

    def reconnect(self) -> None:
        """Connect it again after a fault."""


class TeleopLeader:
    """A leader arm, or another teleoperator of LeRobot's."""

    def __init__(self, link: TeleopLink) -> None:
        """Lead by this device."""
        self._link = link

    def policy(self, station: Station, stage: Stage) -> Policy:
        """Return it as a policy."""
        return _Led(self._link)

    def about(self) -> list[str]:
        """Return where it is."""
        here = zip(self._link.motors, self._link.read().tolist(), strict=True)
        return [f"leader {name}: {position:.1f}" for name, position in here]

    def reconnect(self) -> None:
        """Connect it again."""
        self._link.reconnect()


class _Led:
    """Follows where a teleoperator is."""

    def __init__(self, link: TeleopLink) -> None:
        self._link = link
        self.spec = PolicySpec(name="teleop", reads="last", cameras=(), states=(), chunk_size=1)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Nothing to forget."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return where the teleoperator is now."""
        return ActionChunk(actions=self._link.read().astype(np.float32)[None])


class ScriptedLeader:
    """The scripted expert of a stage's twin, in the numbers of the motors."""

    def policy(self, station: Station, stage: Stage) -> Policy:
        """Return it as a policy."""
        planned = station.driven(dataclasses.replace(station.settings, control_mode="pd_joint_pos"))
        recipe = load_recipe("policies", EXPERT, PolicyRecipe).value
        context = PolicyContext(
            name=EXPERT,
            env=RobotEnv(planned, stage, {}).spec,
            chunking=ONE_BY_ONE,
            n_candidates=len(COLORS),
        )
        return _InMotors(make_from_adapter(recipe.adapter, context, recipe.args), planned.units)

    def about(self) -> list[str]:
        """Nothing is to be checked."""
        return []

    def reconnect(self) -> None:
        """Nothing is to be done."""


class _InMotors:
    """A policy that plans in angles of the arm's model, in the numbers of its motors."""

    def __init__(self, planner: Policy, units: Units) -> None:
        self._planner, self._units = planner, units
        self.spec = planner.spec

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes."""
        self._planner.reset(episodes)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan, and translate."""
        rows = [self._units.goal(row) for row in self._planner.act(window).actions]
        return ActionChunk(actions=np.stack(rows).astype(np.float32))


class BesideLeader:
    """An operator who reads, before the arm follows the leader, how far the two are apart."""

    def __init__(self, operator: Operator, station: Station, link: TeleopLink) -> None:
        """Stand in for an operator."""
        self._operator, self._station, self._link = operator, station, link
        self._follows = False  # whether the arm is to follow next, and not to go home
        self.ask, self.tell = operator.ask, operator.tell
        self.pressed, self.lets_move = operator.pressed, operator.lets_move

    def prepare(self, trial: Trial) -> None:
        """Have the table set; the arm is at home then."""
        self._operator.prepare(trial)
        self._follows = True

    def until_held(self) -> None:
        """Say how far the leader is from the arm, then wait for the dead man's key."""
        if self._follows:
            apart = self._link.read() - self._station.link.read().motors
            worst = int(np.abs(apart).argmax())
            self._operator.tell(
                f"The leader is up to {abs(apart[worst]):.1f} from the arm ({self._link.motors[worst]}). The "
                f"arm comes to it by at most {self._station.settings.max_step:g} per control step."
            )
            self._follows = False
        self._operator.until_held()


def in_motors(settings: RobotSettings) -> RobotSettings:
    """Return how the arm is driven in a demonstration: by positions of its motors."""
    return dataclasses.replace(settings, control_mode=MOTORS)
