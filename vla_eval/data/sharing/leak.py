"""Whether demonstrations begin as episodes of an evaluation do: states are compared, not seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from vla_eval.config.environment import EnvSettings
from vla_eval.core import FloatArray
from vla_eval.data.replaying.episode_check import MIN_PSNR_DB, psnr_db
from vla_eval.data.sharing.initial_states import Frames, InitialStates
from vla_eval.envs.factory import make_env
from vla_eval.errors import DatasetError, some_of
from vla_eval.features import CAMERA_KEYS, StateKind, proprioception
from vla_eval.robots.find import robot_of
from vla_eval.strict.bounds import MAX_SEED
from vla_eval.tasks.catalog import task_spec

SAME_STATE = 1e-3
"""m, rad, rad/s. A reset gives each joint noise of 0.02 rad, so two seeds agree in all seven joints to this
once in 10^11 pairs; what is stored as float32 agrees to 1e-6."""
SLOT = 0

Evidence = Literal["state", "frames"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedStart:
    """An episode of a dataset that begins as an evaluation's episode does."""

    episode: str
    dataset_seed: int | None
    evaluation_seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LeakReport:
    """What a comparison found."""

    task: str
    seeds: range  # of the evaluation
    n_episodes: int  # of the dataset
    # what was compared: the arm's state, or first frames where that is the same for all seeds
    evidence: Evidence
    shared: tuple[SharedStart, ...]  # the episodes that begin alike


@dataclass(frozen=True, slots=True, kw_only=True)
class _Start:
    seed: int
    states: dict[StateKind, FloatArray]
    frames: Frames


def check_leak(dataset: InitialStates, *, task: str, seeds: range) -> LeakReport:
    """Compare how the episodes of a dataset begin with the initial states of a task's evaluation seeds."""
    settings = EnvSettings(task=task_spec(task).id, simulator=dataset.simulator)
    starts = _starts(settings, _with_another(seeds))
    kind = dataset.episodes[0].kind if dataset.episodes else "eef"
    evidence: Evidence = "state"
    if any(_same_state(one.states[kind], other.states[kind]) for one, other in combinations(starts, 2)):
        evidence = "frames"
        shared = _shared_frames(dataset, settings, seeds)
    else:
        shared = [
            SharedStart(episode=episode.name, dataset_seed=episode.seed, evaluation_seed=start.seed)
            for episode in dataset.episodes
            for start in starts[: len(seeds)]
            if _same_state(episode.state, start.states[episode.kind])
        ]
    return LeakReport(
        task=settings.task,
        seeds=seeds,
        n_episodes=len(dataset.episodes),
        evidence=evidence,
        shared=tuple(shared),
    )


def _shared_frames(dataset: InitialStates, settings: EnvSettings, seeds: range) -> list[SharedStart]:
    """Compare first frames: those that a replay takes for the same frame after video are the same."""
    least_db = MIN_PSNR_DB[settings.simulator]
    cameras = tuple(CAMERA_KEYS)
    settings = replace(settings, cameras=cameras)
    starts = _starts(settings, _with_another(seeds), render=True)
    alike = [
        f"{one.seed} and {other.seed}"
        for one, other in combinations(starts, 2)
        if _are_alike(one.frames, other.frames, least_db)
    ]
    if alike:
        raise DatasetError(
            f"{dataset.path}: cannot be compared with the evaluation of {settings.task}: neither the arm's "
            f"state nor the first frames distinguish its seeds (seeds {alike[0]}, for example)."
        )
    first_frames = dataset.read_frames()
    for camera, image in starts[0].frames.items():
        shapes = {frames[camera].shape for frames in first_frames}
        if shapes - {image.shape}:
            raise DatasetError(
                f"{dataset.path}: its images of {camera} are {some_of(sorted(shapes))}, those of the "
                f"evaluation {image.shape}, and the arm's state is the same for several seeds: nothing can "
                "be compared."
            )
    return [
        SharedStart(episode=episode.name, dataset_seed=episode.seed, evaluation_seed=start.seed)
        for episode, frames in zip(dataset.episodes, first_frames, strict=True)
        for start in starts[: len(seeds)]
        if _are_alike(frames, start.frames, least_db)
    ]


def _with_another(seeds: range) -> list[int]:
    """Return the seeds and one more, so that a single one has another to be distinguished from."""
    return [*seeds, seeds[-1] + 1 if seeds[-1] < MAX_SEED else seeds[0] - 1]


def _starts(settings: EnvSettings, seeds: Sequence[int], *, render: bool = False) -> list[_Start]:
    env = make_env(settings)
    try:
        found = []
        for seed in seeds:
            observation = env.reset({SLOT: seed}, render=render)[SLOT].observation
            images = {camera: observation.images[camera] for camera in settings.cameras}
            states = proprioception(observation.state, robot_of(settings.kwargs))
            found.append(_Start(seed=seed, states=states, frames=images))
        return found
    finally:
        env.close()


def _same_state(one: FloatArray, other: FloatArray) -> bool:
    return bool(np.abs(one - other).max() <= SAME_STATE)


def _are_alike(one: Frames, other: Frames, least_db: float) -> bool:
    """Whether the images of every camera are the same up to what a video changes."""
    return all(psnr_db(one[camera], other[camera]) >= least_db for camera in one)
