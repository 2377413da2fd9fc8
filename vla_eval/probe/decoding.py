"""What is in a policy's memory, by linear probes: which item, which place, in which order, how long to wait.

A probe is a ridge regression from the memory after the inference of one control step to what was right in
the episode. Each episode is predicted by a probe that was fitted on others (five folds, by seed), and set
beside the same probe on the newest frame alone. `docs/probe.md` defines each quantity.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.probe.phases import Phases, phases_of
from vla_eval.probe.quantities import follows
from vla_eval.probe.world_records import by_policy, results_of
from vla_eval.probe.worlds import AS_DRAWN, World
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import Share
from vla_eval.results.linear_probe import Vectors, folds_of, predicted
from vla_eval.storage.capture_files import memory_file
from vla_eval.storage.run_folder import StoredRun, read_run
from vla_eval.tasks.catalog import task_spec

LEAST_EPISODES = 10  # at a step; with fewer nothing is fitted
TIME = "time"  # the label that is the control step itself


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """What a probe is asked for."""

    name: str  # `item`, `place`, `item 2` …
    of: Callable[[EpisodeRecord], int | None]  # None where an episode has no answer


class DecodedStep(NamedTuple):
    """How often a probe is right at one control step."""

    step: int
    memory: Share
    frame: Share | None  # of the probe on the newest frame; None for a policy that reads no camera


class Acts(NamedTuple):
    """Episodes by what the memory holds at the response, and whether the policy follows the cue."""

    both: int  # the probe is right, and the policy
    knows: int  # the probe alone
    acts: int  # the policy alone
    neither: int

    @property
    def n(self) -> int:
        """All of them."""
        return sum(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Decoded:
    """What one policy's memory says of one label."""

    task: str
    policy: str
    n_action_steps: int
    label: str
    chance: float  # of the most frequent answer
    response_step: int
    steps: tuple[DecodedStep, ...]
    acts: Acts | None  # of what a policy can choose; None without an inference at the response


def decoded_memories(worlds: Sequence[World], runs: Sequence[StoredRun]) -> list[Decoded]:
    """Return what can be decoded in the worlds as drawn, of all policies whose memory was kept there."""
    found: list[Decoded] = []
    for world, run in zip(worlds, runs, strict=True):
        spec = task_spec(world.task)
        phases = phases_of(spec, world.config.env)
        if world.intervention != AS_DRAWN or not isinstance(phases, Phases):
            continue
        for (policy, k), records in by_policy(run.records).items():
            episodes = _episodes(results_of(records), run.path)
            time = _time(episodes, phases, task=world.task, policy=policy, k=k)
            found += [time] if time is not None else []
            for label in _labels([record for record, _ in episodes]):
                one = _decoded(episodes, label, phases, task=world.task, policy=policy, k=k)
                found += [one] if one is not None else []
    return found


def kept_nothing(worlds: Sequence[World], out: Path) -> list[str]:
    """Return a line for each world as drawn in which memories were not kept."""
    lines = []
    for world in worlds:
        if world.intervention != AS_DRAWN:
            continue
        run = read_run(out / world.config.name)
        memories = run.description.memories
        missing = [
            record
            for record in results_of(run.records)
            if memories.get(record.policy) and not memory_file(run.path, record).is_file()
        ]
        if missing:
            lines.append(
                f"{run.path}: {len(missing)} of {len(run.records)} episodes were run without --decode, and "
                "of their memory nothing was kept: remove the folder to run them again."
            )
    return lines


_Episodes = Sequence[tuple[EpisodeRecord, EpisodeMemory]]


def _episodes(records: Sequence[EpisodeRecord], folder: Path) -> list[tuple[EpisodeRecord, EpisodeMemory]]:
    files = [(record, memory_file(folder, record)) for record in records]
    return [(record, EpisodeMemory.read(path)) for record, path in files if path.is_file()]


def _labels(records: Sequence[EpisodeRecord]) -> list[Label]:
    """Return what is worth asking: not what has one answer alone, nor the same answers as another label."""
    n_shown = max((len(record.right_candidates or ()) for record in records), default=0)
    asked = [
        Label(name="item", of=lambda record: record.target),
        Label(name="place", of=lambda record: record.target_place),
    ]
    if n_shown > 1:
        asked += [Label(name=f"item {i + 1}", of=_shown_at(i)) for i in range(n_shown)]
    by_answers = {
        tuple(map(label.of, records)): label for label in reversed(asked)
    }  # the first of a kind stays
    worth = [label for answers, label in by_answers.items() if len(set(answers) - {None}) > 1]
    return worth[::-1]


def _shown_at(index: int) -> Callable[[EpisodeRecord], int | None]:
    def of(record: EpisodeRecord) -> int | None:
        shown = record.right_candidates or ()
        return shown[index] if index < len(shown) else None

    return of


def _decoded(
    episodes: _Episodes, label: Label, phases: Phases, *, task: str, policy: str, k: int
) -> Decoded | None:
    answered = [(record, memory) for record, memory in episodes if label.of(record) is not None]
    answers = [label.of(record) for record, _ in answered]
    steps: list[DecodedStep] = []
    acts = None
    for step in sorted({int(one) for _, memory in answered for one in memory.steps}):
        there = [(record, memory) for record, memory in answered if step in memory.steps]
        if len(there) < LEAST_EPISODES:
            continue
        labels = [answer for record, _ in there if (answer := label.of(record)) is not None]
        at = [one.steps.tolist().index(step) for _, one in there]
        seeds = [record.seed for record, _ in there]
        memories = [(one.memory, row) for (_, one), row in zip(there, at, strict=True)]
        frames = [(one.frames, row) for (_, one), row in zip(there, at, strict=True)]
        right, frame = _is_right(memories, labels, seeds), _share(frames, labels, seeds)
        if right is None:
            continue
        steps.append(DecodedStep(step, Share(int(right.sum()), len(right)), frame))
        if acts is None and step >= phases.response_step and label.name in ("item", "place"):
            acted = np.array([follows(record) for record, _ in there])
            acts = Acts(
                both=int((right & acted).sum()),
                knows=int((right & ~acted).sum()),
                acts=int((~right & acted).sum()),
                neither=int((~right & ~acted).sum()),
            )
    if not steps:
        return None
    return Decoded(
        task=task,
        policy=policy,
        n_action_steps=k,
        label=label.name,
        chance=max(answers.count(one) for one in set(answers)) / len(answers),
        response_step=phases.response_step,
        steps=tuple(steps),
        acts=acts,
    )


def _time(episodes: _Episodes, phases: Phases, *, task: str, policy: str, k: int) -> Decoded | None:
    """Return how often a probe names the step, at the inferences before the response."""
    waiting = [
        (record, memory, row, int(step))
        for record, memory in episodes
        for row, step in enumerate(memory.steps)
        if step < phases.response_step
    ]
    steps = [step for *_, step in waiting]
    if len(episodes) < LEAST_EPISODES or len(set(steps)) < 2:
        return None
    seeds = [record.seed for record, *_ in waiting]
    memory = _share([(one.memory, row) for _, one, row, _ in waiting], steps, seeds)
    frame = _share([(one.frames, row) for _, one, row, _ in waiting], steps, seeds)
    if memory is None:
        return None
    return Decoded(
        task=task,
        policy=policy,
        n_action_steps=k,
        label=TIME,
        chance=max(steps.count(one) for one in set(steps)) / len(steps),
        response_step=phases.response_step,
        steps=(DecodedStep(max(steps), memory, frame),),
        acts=None,
    )


def _share(
    rows: Sequence[tuple[Mapping[str, NDArray[Any]], int]], labels: Sequence[int], seeds: Sequence[int]
) -> Share | None:
    right = _is_right(rows, labels, seeds)
    return None if right is None else Share(int(right.sum()), len(right))


def _features(rows: Sequence[tuple[Mapping[str, NDArray[Any]], int]]) -> list[Vectors]:
    """Return (N, D) for each array that all files have in one shape, of one row of each file's."""
    names = [name for name in sorted(rows[0][0]) if all(name in arrays for arrays, _ in rows)]
    parts = [[arrays[name][row].ravel() for arrays, row in rows] for name in names]
    same = [part for part in parts if len({len(one) for one in part}) == 1 and len(part[0])]
    return [np.array(part, np.float64) for part in same]


def _is_right(
    rows: Sequence[tuple[Mapping[str, NDArray[Any]], int]], labels: Sequence[int], seeds: Sequence[int]
) -> NDArray[np.bool_] | None:
    """Return for each row whether the probe of the other folds is right; None without features."""
    features = _features(rows)
    if not features:
        return None
    asked = np.array(labels)
    right: NDArray[np.bool_] = predicted(features, asked, folds_of(seeds)) == asked
    return right
