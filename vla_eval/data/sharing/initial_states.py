"""How the episodes of a dataset in any layout begin: the arm's state and the images of the first frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.config.environment import Simulator
from vla_eval.core import FloatArray, ImageArray
from vla_eval.data.facts import DatasetFacts, ImportFacts, MixtureFacts, find_facts
from vla_eval.data.foreign.convert import find_source
from vla_eval.data.foreign.episodes import EEF_KEY, JOINTS_KEY, SOURCE_PROPRIO_KEY, Source, SourceEpisode
from vla_eval.data.foreign.import_writer import eef_of_proprio
from vla_eval.data.manifest import read_manifest
from vla_eval.errors import DatasetError
from vla_eval.features import CAMERA_KEYS, StateKind

Frames = dict[str, ImageArray]
"""Camera -> (H, W, 3) uint8."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialState:
    """How one episode of a dataset begins."""

    name: str
    seed: int | None  # of its own environment; None if it is not known
    # `kind`, `state`: proprioception of the first frame as `features.proprioception` gives it
    kind: StateKind
    state: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialStates:
    """How the episodes of a dataset begin."""

    path: Path
    task: str | None  # task id; None if the dataset names none
    simulator: Simulator  # of the recording; ManiSkill for what was not recorded here
    episodes: tuple[InitialState, ...]
    # reads the first frame of each episode; decoding takes a while
    read_frames: Callable[[], list[Frames]]


def read_initial_states(path: Path) -> InitialStates:
    """Read how the episodes of any dataset begin that `dataset convert` reads, or raise `DatasetError`."""
    source = find_source(path)
    seeds, task, simulator = _recorded_facts(source)
    states = []
    for episode, seed in zip(source.episodes, seeds, strict=True):
        kind, state = _state_of(episode)
        states.append(InitialState(name=episode.name, seed=seed, kind=kind, state=state.astype(np.float32)))
    return InitialStates(
        path=path,
        task=task,
        simulator=simulator,
        episodes=tuple(states),
        read_frames=lambda: [
            {camera: images[0] for camera, images in zip(CAMERA_KEYS, episode.read_images(), strict=True)}
            for episode in source.episodes
        ],
    )


def _state_of(episode: SourceEpisode) -> tuple[StateKind, FloatArray]:
    firsts: Mapping[str, Any] = {name: rows[0] for name, rows in episode.numbers.items()}  # Any: numbers
    if JOINTS_KEY in firsts:
        return "joints", firsts[JOINTS_KEY]
    if EEF_KEY in firsts:
        return "eef", firsts[EEF_KEY]
    return "eef", eef_of_proprio(firsts[SOURCE_PROPRIO_KEY])  # a source has one of the three


def _recorded_facts(source: Source) -> tuple[Sequence[int | None], str | None, Simulator]:
    """Return seeds, task and simulator as far as `meta/mikasa` knows them, or raise `DatasetError`."""
    root, n_episodes = source.path, len(source.episodes)
    facts = find_facts(root)
    if isinstance(facts, MixtureFacts):
        names = ", ".join(source.name for source in facts.sources)
        raise DatasetError(
            f"{root}: was mixed of several datasets ({names}). Compare each of those with the evaluation's "
            "episodes of its task: mikasa-vla dataset check-leak DIR"
        )
    seeds: Sequence[int | None] = [episode.seed for episode in source.episodes]
    task: str | None = None
    simulator: Simulator = "maniskill"
    if isinstance(facts, DatasetFacts):
        task = facts.task
        simulator = "fake" if facts.recipe.get("simulator") == "fake" else "maniskill"
        seeds = [episode.seed for episode in read_manifest(root)]
    elif isinstance(facts, ImportFacts):
        task = facts.task
        seeds = [episode.source_seed for episode in facts.episodes]
    if len(seeds) != n_episodes:
        raise DatasetError(
            f"{root}: its tables hold {n_episodes} episodes, meta/mikasa describes {len(seeds)}. Fetch or "
            "record the dataset again."
        )
    return seeds, task, simulator
