"""Convert the actions of a recorded dataset to another control mode: the same motion, commanded differently.

Each episode is replayed as it was recorded, and the joint positions at which the arm's controller really
aimed are read from the simulator. Then it is run again in the other mode, with actions that aim at them. An
episode that does not succeed there is left out.
"""

import dataclasses
import operator
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.control_modes import CONTROL_MODE, EE_DELTA_POSE, action_spec
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    ObservationWindow,
    SimEnv,
    StepObserver,
    StepResult,
)
from vla_eval.data.derived.changed_actions import copy_with_actions
from vla_eval.data.derived.rebuild import failed_attempt
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import (
    RecordedEpisode,
    encode_actions,
    manifest_sha256,
    read_failed,
    read_manifest,
)
from vla_eval.data.recording.demonstrations import ONE_BY_ONE, Attempt, EpisodeLog, RecordedActions, attempt
from vla_eval.data.recording.jobs import TaskPlan
from vla_eval.data.recording.plan import plan_recording
from vla_eval.data.recording.record import RecordedDataset, RecordingObserver, record
from vla_eval.data.recording.seed_queue import Selection
from vla_eval.data.replaying.episode_check import check_states
from vla_eval.data.replaying.replay import check_task_versions, recipe_of
from vla_eval.data.tables import Columns, read_columns, rows_of_episode
from vla_eval.envs.factory import make_env
from vla_eval.errors import DatasetError
from vla_eval.oracles.translation import command, joint_target
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec


@dataclass(frozen=True, slots=True, kw_only=True)
class Converted:
    """The outcome of a conversion."""

    dataset: RecordedDataset
    n_episodes: int  # episodes of the old dataset
    n_same_states: int  # how many of the new ones have the old one's states, bit for bit
    left_out: tuple[str, ...]  # a sentence for each episode that is not in the new one


def convert_control_mode(
    dataset: Path,
    mode: str,
    *,
    out: Path,
    observer: RecordingObserver,
    workers: int | Literal["auto"] = "auto",
) -> Converted | None:
    """Write OUT/TASK with the episodes of a recorded dataset in another control mode; None if asked to stop.

    Where all episodes survive with the states that were recorded, bit for bit, the images are those of the
    recording. Otherwise they are rendered again; after an interruption the same call resumes the rendering.
    """
    action_spec(mode)
    begun = time.monotonic()
    facts, episodes = read_facts(dataset), read_manifest(dataset)
    if facts.control_mode == mode:
        raise DatasetError(f"{dataset}: its actions are for {mode} already. Name another --control-mode.")
    check_task_versions(dataset, episodes)
    recipe = recipe_of(facts)
    recipe = dataclasses.replace(
        recipe, tasks=(facts.task,), workers=workers, env=_env_arguments(recipe, mode), episodes=len(episodes)
    )
    (plan,) = plan_recording(recipe).tasks
    tried = _try_all(dataset, episodes, plan, observer)
    if tried is None:
        return None
    kept = [one for one, why in tried if not why]
    if not kept:
        raise DatasetError(f"{dataset}: no episode succeeds in {mode}; the first: {tried[0][1]}.")
    earlier = [failed_attempt(one.seed, one.n_steps) for one in read_failed(dataset)]
    failed = [*earlier, *(one for one, why in tried if why)]
    recorded = {episode.seed: episode.states_sha256 for episode in episodes}
    n_same_states = sum(one.states_sha256 == recorded[one.seed] for one in kept)
    recipe = dataclasses.replace(recipe, episodes=len(kept))
    if n_same_states == len(episodes):
        copy_with_actions(dataset, out / plan.task, _with_actions(episodes, kept, recipe), recipe)
        made = RecordedDataset.read(out / plan.task, seconds=time.monotonic() - begun)
    else:
        summary = record(
            recipe,
            out=out,
            observer=observer,
            selections={
                plan.task: Selection(
                    kept=tuple(kept), failed=tuple(sorted(failed, key=operator.attrgetter("seed")))
                )
            },
            source=manifest_sha256(dataset),
        )
        if summary.was_stopped:
            return None
        (made,) = summary.datasets
    return Converted(
        dataset=made,
        n_episodes=len(episodes),
        n_same_states=n_same_states,
        left_out=tuple(f"seed {one.seed}: {why}" for one, why in tried if why),
    )


def _with_actions(
    episodes: Sequence[RecordedEpisode], kept: Sequence[Attempt], recipe: DatasetRecipe
) -> list[RecordedEpisode]:
    env = dict(recipe.env)
    return [
        dataclasses.replace(
            episode, env_kwargs=env, actions=one.actions, intended_actions=one.intended_actions
        )
        for episode, one in zip(episodes, kept, strict=True)
    ]


def _env_arguments(recipe: DatasetRecipe, mode: str) -> dict[str, object]:
    """Return the task's arguments with the new mode; the default is not named, as in a recording."""
    arguments = {name: value for name, value in recipe.env.items() if name != CONTROL_MODE}
    return arguments if mode == EE_DELTA_POSE else {**arguments, CONTROL_MODE: mode}


def _try_all(
    dataset: Path, episodes: Sequence[RecordedEpisode], plan: TaskPlan, observer: RecordingObserver
) -> list[tuple[Attempt, str]] | None:
    """Return each episode in the new mode, with the reason why it does not survive, or an empty text."""
    old = make_env(dataclasses.replace(plan.group.env, kwargs=episodes[0].env_kwargs))
    new = make_env(plan.group.env)
    columns = read_columns(dataset)
    observer.on_phase(plan.task, "converting", n_done=0, n_total=len(episodes))
    tried = []
    try:
        for episode in episodes:
            if observer.on_tick():
                return None
            tried.append(convert_episode(old, new, episode, columns, plan))
            observer.on_progress(n_done=len(tried))
    finally:
        old.close()
        new.close()
    return tried


@runtime_checkable
class JointAims(Protocol):
    """An environment that says where the arm's joints are to go."""

    def joint_targets(self, slot: int) -> FloatArray:
        """Return the (7,) joint positions, rad, at which the controller has aimed since the last action."""


def convert_episode(
    old: SimEnv, new: SimEnv, episode: RecordedEpisode, columns: Columns, plan: TaskPlan
) -> tuple[Attempt, str]:
    """Return an episode in the mode of `new`, and why it does not survive there, or an empty text."""
    aims, log = _aims(old, episode)
    rows = rows_of_episode(columns, episode.episode_index)
    different = check_states(episode, rows, log, expect_equal_bits=False)
    follower = AimFollower(
        aims, episode, old_mode=old.spec.action.control_mode, mode=new.spec.action.control_mode
    )
    start = plan.start(episode.seed, horizon_steps=new.spec.horizon_steps)
    one = attempt(new, follower, start, plan.group.rollout, heartbeat=lambda _: None)
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


class _AimLog(StepObserver):
    def __init__(self, env: JointAims) -> None:
        self._env = env
        self.aims: list[FloatArray] = []

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
