"""Rebuild a dataset from its manifest: an episode is a function of (task, arguments, seed, actions)."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import FAILED_FILE, manifest_sha256, read_failed, read_manifest
from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.data.recording.record import RecordedDataset, RecordingObserver, record
from vla_eval.data.recording.seed_queue import Selection
from vla_eval.data.replaying.replay import check_task_versions, recipe_of
from vla_eval.errors import DatasetError
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL


@dataclass(frozen=True, slots=True, kw_only=True)
class Rebuilt:
    """The new dataset, and how many of its episodes have the raw images of the old one."""

    dataset: RecordedDataset
    n_same_images: int


def rebuild(
    dataset: Path,
    *,
    out: Path,
    observer: RecordingObserver,
    workers: int | Literal["auto"] = "auto",
    backend: Backend = LOCAL,
) -> Rebuilt | None:
    """Rebuild a dataset in OUT/TASK from its manifest; None if asked to stop: the same call resumes."""
    episodes = read_manifest(dataset)
    if not episodes:
        raise DatasetError(f"{dataset}: the manifest has no episodes.")
    check_task_versions(dataset, episodes)
    task = episodes[0].task
    recipe = dataclasses.replace(recipe_of(read_facts(dataset)), tasks=(task,), workers=workers)
    failed = read_failed(dataset) if (dataset / FAILED_FILE).exists() else ()
    names = [field.name for field in dataclasses.fields(Attempt)]
    selection = Selection(
        kept=tuple(Attempt(**{name: getattr(one, name) for name in names}) for one in episodes),
        failed=tuple(failed_attempt(one.seed, one.n_steps) for one in failed),
    )
    summary = record(
        recipe,
        out=out,
        observer=observer,
        selections={task: selection},
        source=manifest_sha256(dataset),
        backend=backend,
    )
    if summary.was_stopped:
        return None
    (made,) = summary.datasets
    pairs = zip(episodes, read_manifest(made.path), strict=True)
    return Rebuilt(
        dataset=made, n_same_images=sum(old.images_sha256 == new.images_sha256 for old, new in pairs)
    )


def failed_attempt(seed: int, n_steps: int) -> Attempt:
    """Return the attempt of a failed seed, which is not rendered."""
    return Attempt(
        seed=seed,
        success_step=None,
        n_steps=n_steps,
        cue_steps=0,
        delay_steps=0,
        actions="",
        intended_actions=None,
        states_sha256="",
    )
