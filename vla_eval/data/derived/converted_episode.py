"""One recorded episode in another control mode: where its joints were to go, and what aims there."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, ObservationWindow, SimEnv, Stage, StepResult
from vla_eval.data.manifest import RecordedEpisode, encode_actions
from vla_eval.data.recording.demonstrations import ONE_BY_ONE, Attempt, EpisodeLog, RecordedActions, attempt
from vla_eval.data.recording.jobs import TaskPlan
from vla_eval.data.replaying.episode_check import check_states
from vla_eval.data.tables import Columns, rows_of_episode
from vla_eval.errors import DatasetError
from vla_eval.oracles.translation import command, joint_target
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec


@runtime_checkable
class JointAims(Protocol):
    """An environment that says where the arm's joints are to go."""

    def joint_targets(self, slot: int) -> FloatArray:
        """Return the (7,) joint positions, rad, at which the controller has aimed since the last action."""


def convert_episode(
    old: SimEnv, new: SimEnv, episode: RecordedEpisode, columns: Columns, plan: TaskPlan
) -> tuple[Attempt, str]:
    """Return an episode in the mode of the new environment, and why it does not survive, or an empty text.

    `old` is the environment of the recording, `columns` are the numbers of the recorded dataset.
    """
    aims, log = _aims(old, episode)
    rows = rows_of_episode(columns, episode.episode_index)
    different = check_states(episode, rows, log, expect_equal_bits=False)
    follower = AimFollower(
        aims, episode, old_mode=old.spec.action.control_mode, mode=new.spec.action.control_mode
    )
    start = plan.start(episode.seed, horizon_steps=new.spec.horizon_steps)
    one = attempt(new, follower, start, plan.group.rollout, heartbeat=_ignore)
    if episode.intended_actions is not None:
        intended = new.spec.action.clipped(np.stack(follower.intended[: one.n_steps]))
        one = dataclasses.replace(one, intended_actions=encode_actions(intended))
    if different:
        return one, f"its replay is not what was recorded: {different[0]}"
    if one.success_step is None and episode.success_step is not None:
        return one, f"no success in {new.spec.action.control_mode} within {one.n_steps} steps"
    return one, ""


def _aims(env: SimEnv, episode: RecordedEpisode) -> tuple[FloatArray, EpisodeLog]:
    """Replay an episode; return where the joints were to go, (n_steps, 7), and its results."""
    if not isinstance(env, JointAims):
        raise DatasetError(
            f"{env.spec.task}: this dataset was recorded with a simulator without joints. Record it with the "
            "simulator 'maniskill'."
        )
    log, noted = EpisodeLog(), _AimLog(env)
    settings = RolloutSettings(chunking=ONE_BY_ONE)
    rollout(env, RecordedActions(episode.action_rows()), [episode.start()], settings, observers=[log, noted])
    return np.stack(noted.aims), log


def _ignore(_stage: Stage) -> None:
    """No watchdog listens: episodes are converted in the command's own process."""


class _AimLog:
    def __init__(self, env: JointAims) -> None:
        self._env = env
        self.aims: list[FloatArray] = []

    def wants_images(self, step: int) -> bool:
        return False

    def _ignore(self, *_: object) -> None:
        """Do nothing."""

    on_reset = on_inference = _ignore

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        self.aims.append(self._env.joint_targets(episode.slot))


class AimFollower:
    """A policy that aims, in another control mode, where the arm was to go in a recorded episode.

    Beyond the recorded steps it continues to aim at the last place: a mode with narrower bounds needs longer.
    Its `intended` actions aim where the expert wanted to go before noise was added.
    """

    def __init__(self, aims: FloatArray, episode: RecordedEpisode, *, old_mode: str, mode: str) -> None:
        self._aims = aims.astype(float)
        self._grippers = episode.action_rows()[:, -1]
        self._intended_rows = episode.intended_rows()
        self._old_mode, self._mode = old_mode, mode
        self.intended: list[FloatArray] = []
        self.spec = PolicySpec(name="aims", reads="last", cameras=(), states=("qpos",), chunk_size=1)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin with nothing intended."""
        self.intended = []

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Aim where the arm was to go at this step."""
        qpos = window.last.state["qpos"].astype(float)
        step = min(window.last.step, len(self._aims) - 1)
        gripper = float(self._grippers[step])
        if self._intended_rows is not None:
            wanted = joint_target(self._old_mode, self._intended_rows[step], qpos)
            self.intended.append(command(self._mode, wanted, gripper, qpos))
        return ActionChunk(actions=command(self._mode, self._aims[step], gripper, qpos)[None])
