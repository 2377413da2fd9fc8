"""Put complete datasets of several tasks together as one LeRobotDataset, for a policy that learns them all.

lerobot's `aggregate_datasets` does it: videos byte for byte; episodes and frames are numbered again.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # lerobot is untyped

from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.io_utils import write_stats

from vla_eval import __version__
from vla_eval.data.check import require_checked
from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.exact_statistics import QUANTILES, vector_statistics
from vla_eval.data.facts import ArmFacts, DatasetFacts, MixtureFacts, MixtureSource
from vla_eval.data.manifest import MIXTURE_FILE, write_entry
from vla_eval.data.opening import OpenDataset, join_datasets, open_dataset
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError
from vla_eval.storage.drafts import whole_folder


def mix_datasets(roots: Sequence[Path], out: Path) -> MixtureFacts:
    """Write one dataset of the episodes of two or more complete ones, in their order; return what it is.

    Raises:
        DatasetError: one is not complete, its replay found a mismatch, two are the same or differ in what a
            policy sees or does; or `out` exists.
        StorageFullError: it could not be written; nothing is left.
    """
    opened = [_open(root) for root in roots]
    if len(opened) < 2:
        raise DatasetError(f"expected at least two datasets to mix, found {len(opened)}.")
    for other in opened[1:]:
        _refuse_difference(opened[0], other)
    sources = tuple(_source(one) for one in opened)
    _refuse_repetition(sources)
    with whole_folder(out, error=DatasetError) as draft:
        try:
            join_datasets(roots, draft, concatenate_videos=False, concatenate_data=False)
        except ValueError as exc:
            named = ", ".join(map(str, roots))
            raise DatasetError(f"lerobot cannot put {named} together: {exc!s:.300}") from exc
        write_statistics(draft, [one.meta for one in opened])
        facts = MixtureFacts(
            complete=True,
            state=opened[0].facts.state,
            control_mode=opened[0].facts.control_mode,
            sources=sources,
            files=digest_files(draft),
            vla_eval_version=__version__,
        )
        write_entry(draft / MIXTURE_FILE, facts)
    return facts


def _open(root: Path) -> OpenDataset:
    dataset = open_dataset(root)
    if isinstance(dataset.facts, MixtureFacts):
        names = ", ".join(source.name for source in dataset.facts.sources)
        raise DatasetError(f"{root}: is a mixture itself, of {names}. Name those instead.")
    require_checked(dataset)
    return dataset


def _source(opened: OpenDataset) -> MixtureSource:
    facts, meta = opened.facts, opened.meta
    return MixtureSource(
        name=opened.name,
        task=facts.task,
        task_version=facts.task_version if isinstance(facts, DatasetFacts) else None,
        instructions=tuple(sorted(str(sentence) for sentence in meta.tasks.index)),
        n_episodes=int(meta.total_episodes),
        n_frames=int(meta.total_frames),
        sha256=opened.sha256,
        seeds=_seeds(opened),
        failed_seeds=tuple(failed.seed for failed in opened.failed_seeds),
        was_replayed=opened.was_replayed,
    )


def _seeds(opened: OpenDataset) -> tuple[int, ...] | None:
    if isinstance(opened.facts, ArmFacts):
        return tuple(one.seed for one in opened.facts.episodes)
    is_recorded = isinstance(opened.facts, DatasetFacts)
    return tuple(episode.seed for episode in opened.manifest) if is_recorded else None


def _refuse_difference(first: OpenDataset, other: OpenDataset) -> None:
    expected, found = _form(first), _form(other)
    for what in {**expected, **found}:
        if expected.get(what) != found.get(what):
            raise DatasetError(
                f"{first.root} and {other.root} cannot be mixed: {what} is {_shown(expected.get(what))} in "
                f"the first and {_shown(found.get(what))} in the second. Record or convert one as the other."
            )


def _form(opened: OpenDataset) -> dict[str, Any]:
    """Return what has to be alike: name -> value. How frames were encoded may differ."""
    features: dict[str, Any] = opened.meta.features
    return {
        "the state": opened.facts.state,
        "the control mode": opened.facts.control_mode,
        "frames per second": opened.meta.fps,
        **{f"the shape of {name}": tuple(feature["shape"]) for name, feature in features.items()},
        **{f"the type of {name}": feature["dtype"] for name, feature in features.items()},
        **{f"the names of {name}": feature.get("names") for name, feature in features.items()},
        "the robot": opened.meta.robot_type,
    }


def _shown(value: object) -> str:
    return "not there" if value is None else str(value)


def _refuse_repetition(sources: Sequence[MixtureSource]) -> None:
    by_content: dict[str, str] = {}
    for source in sources:
        if source.sha256 in by_content:
            raise DatasetError(
                f"{by_content[source.sha256]} and {source.name} are the same dataset: its episodes would "
                "count twice. Name it once."
            )
        by_content[source.sha256] = source.name


def write_statistics(root: Path, metas: Sequence[Any]) -> None:
    """Write exact statistics of numbers, and those of images, without quantiles, from the sources'."""
    numbers = {key: rows.reshape(len(rows), -1) for key, rows in read_columns(root).items()}
    cameras = metas[0].video_keys
    images = aggregate_stats(
        [
            {
                camera: {name: value for name, value in meta.stats[camera].items() if name not in QUANTILES}
                for camera in cameras
            }
            for meta in metas
        ]
    )
    in_order = {camera: images[camera] for camera in cameras}  # lerobot's is that of a set
    write_stats({**{key: vector_statistics(rows) for key, rows in numbers.items()}, **in_order}, root)
