"""`mikasa-vla dataset check`: a report on a dataset, whichever program made it. Decodes no image."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple  # lerobot is untyped

import numpy as np
from av.error import FFmpegError

from vla_eval.control_modes import CONTROL_MODES, POSITION
from vla_eval.data.checks.agreement import episodes_by_video
from vla_eval.data.checks.demonstrated import Demonstrations
from vla_eval.data.checks.rules import Answer, find_breaches, require_sound
from vla_eval.data.dataset_folder import check_complete
from vla_eval.data.facts import MixtureFacts, has_facts
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.foreign.convert import find_source
from vla_eval.data.foreign.episodes import Source
from vla_eval.data.foreign.lerobot_files import OF_LEROBOT, lerobot_source, names_of
from vla_eval.data.frames.frame_cache import channels_first
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.opening import LocalDataset, OpenDataset
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, IMAGE_SIZE_PX, PROPRIO_KEYS, STATE_KEY, STATE_NAMES
from vla_eval.tasks.real_stages import told_by
from vla_eval.viz.mp4 import open_mp4

STATISTICS = ("min", "max", "mean", "std")
"""Of `meta/stats.json`; not its quantiles, since lerobot averages those of episodes."""
STATISTICS_TOLERANCE = 1e-3  # relative; lerobot computes in float32


class Said(NamedTuple):
    """One line of the report."""

    answer: Answer
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport:
    """What was found in a dataset, and the command that can be run with it next."""

    path: Path
    kind: str
    demonstrations: Demonstrations
    said: tuple[Said, ...]
    next_step: str

    @property
    def is_refused(self) -> bool:
        """Whether something has to be changed before it can be used."""
        return any(one.answer == "refused" for one in self.said)


def check(path: Path) -> CheckReport:
    """Look at all of a dataset but the pixels.

    Raises:
        DatasetError: there is nothing that can be read, or its files do not belong together.
    """
    check_folder(path)
    if not (path / INFO_FILE).is_file():
        return _of_source(find_source(path), "")
    facts = check_complete(path) if has_facts(path) else None
    dataset = LocalDataset(path)
    demonstrations = demonstrations_of(dataset)
    found = (*check_videos(dataset), *_statistics(dataset, demonstrations))
    if facts is not None or has_our_fields(dataset.meta.features) or demonstrations.of_an_arm:
        known: Iterable[Said] = _breaches(demonstrations)
        kind = "a LeRobotDataset with the fields of this project, without its records"
        if facts is not None and facts.is_checked:  # the rules were applied when it was made
            known = (Said("kept", sentence) for sentence in facts.kept)
        elif demonstrations.of_an_arm and facts is None:
            known = (*known, *(Said("kept", sentence) for sentence in about_arm(demonstrations)))
            kind = "a LeRobotDataset of an arm's motors"
        return CheckReport(
            path=path,
            kind=kind if facts is None else facts.kind,
            demonstrations=demonstrations,
            said=(*found, *known),
            next_step=f"mikasa-vla dataset adopt {path}" if facts is None else "",
        )
    kind = "a LeRobotDataset"
    try:
        report = _of_source(lerobot_source(dataset), kind)
    except DatasetError as exc:
        said = (*found, Said("refused", str(exc)), *_breaches(demonstrations))
        return CheckReport(path=path, kind=kind, demonstrations=demonstrations, said=said, next_step="")
    return dataclasses.replace(report, said=(*found, *report.said))


def demonstrations_of(dataset: LocalDataset) -> Demonstrations:
    """Return what is checked of a dataset by the names in its own `meta/info.json`."""
    meta, all_columns = dataset.meta, dataset.columns
    columns = {
        name: rows
        for name, rows in all_columns.items()
        if name not in OF_LEROBOT and rows.dtype.kind in "biuf"
    }
    names = {name: names_of(meta.features[name]) for name in columns}
    sentences = meta.tasks.index
    lengths = tuple(dataset.lengths)
    return Demonstrations(
        of_an_arm=is_of_an_arm(meta.features),
        where=dataset.root,
        fps=meta.fps,
        names=tuple(f"episode {number}" for number in range(len(lengths))),
        lengths=lengths,
        columns=columns,
        dims={name: known for name, known in names.items() if known},
        sentences=tuple(str(sentences[int(index)]) for index in all_columns["task_index"]),
        action=next((spec for spec in CONTROL_MODES.values() if spec.dims == names.get(ACTION_KEY)), None),
        image_sizes_px={
            camera: channels_first(meta.features[camera])[1:]
            for camera in meta.camera_keys
            if camera not in meta.depth_keys
        },
    )


def has_our_fields(features: Any) -> bool:  # Any: lerobot's plain data
    """Whether a dataset has the fields that policies here are trained on, with our names of numbers."""
    states = [names_of(features[STATE_KEY])] if STATE_KEY in features else []
    modes = [spec.dims for spec in CONTROL_MODES.values()]
    return (
        set(CAMERA_KEYS.values()) <= set(features)
        and any(state in STATE_NAMES.values() for state in states)
        and any(key in features for key in PROPRIO_KEYS.values())
        and ACTION_KEY in features
        and names_of(features[ACTION_KEY]) in modes
    )


def is_of_an_arm(features: Any) -> bool:  # Any: lerobot's plain data
    """Whether state and action are the positions of the same motors, as LeRobot's robots name them."""
    if STATE_KEY not in features or ACTION_KEY not in features:
        return False
    state, action = names_of(features[STATE_KEY]), names_of(features[ACTION_KEY])
    return bool(state) and state == action and all(name.endswith(POSITION) for name in state)


def about_arm(what: Demonstrations) -> tuple[str, ...]:
    """Return what should be known of demonstrations on an arm that another program recorded."""
    said = [
        "It has no phases: in which frames the cue is shown is not stored.",
        "Whether the motors' numbers are degrees, or -100 to 100, is not stored: `use_degrees` of the arm "
        "that a policy of it drives has to be as it was in the recording.",
    ]
    for sentence in sorted({one for one in what.sentences if one}):
        told = told_by(sentence)
        stages = " or ".join(stage.name for stage in told.stages) or "none of the three stages"
        color = f", {told.color}" if told.color else ", and no colour"
        said.append(f"By its sentence {sentence!r:.200}: {stages}{color if told.stages else ''}.")
    return tuple(said)


def _of_source(source: Source, kind: str) -> CheckReport:
    path = source.path
    demonstrations = source.demonstrations(expected_px=IMAGE_SIZE_PX)
    said = [Said("kept", f"{remark}.") for remark in source.remarks]
    if source.left_out:
        said.append(Said("kept", f"A conversion leaves out {', '.join(source.left_out)}."))
    return CheckReport(
        path=path,
        kind=kind or f"{len(source.files)} npz files",
        demonstrations=demonstrations,
        said=(*said, *_breaches(demonstrations)),
        next_step=f"mikasa-vla dataset convert {path} --to lerobot --out DIR",
    )


def require_checked(dataset: OpenDataset) -> None:
    """Apply the rules to a mixture or an import that an older version made, or raise `DatasetError`."""
    if not dataset.facts.is_checked:
        is_mixture = isinstance(dataset.facts, MixtureFacts)
        require_sound(dataclasses.replace(demonstrations_of(dataset.local), is_gripper_named=is_mixture))


def _breaches(demonstrations: Demonstrations) -> Iterator[Said]:
    for one in find_breaches(demonstrations):
        yield Said(one.rule.answer, str(one))


def check_videos(dataset: LocalDataset) -> Iterator[Said]:
    """Compare the headers of videos with their description in `meta/`."""
    root, meta, lengths = dataset.root, dataset.meta, dataset.lengths
    for path, (camera, numbers) in episodes_by_video(meta).items():
        if camera in meta.depth_keys:
            continue
        needed = sum(lengths[number] for number in numbers)
        try:
            with open_mp4(root / path, DatasetError) as container:
                stream = container.streams.video[0]
                size, n_frames, fps = (stream.height, stream.width), stream.frames, stream.average_rate
        except (FFmpegError, LookupError) as exc:
            yield Said("refused", f"{path}: cannot be read as a video ({exc!s:.100}).")
            continue
        expected = channels_first(meta.features[camera])[1:]
        if size != expected:
            found = f"{size[0]} × {size[1]} px, expected {expected[0]} × {expected[1]}"
            yield Said("refused", f"{path}: its frames are {found} (meta/info.json).")
        if n_frames < needed:
            yield Said(
                "refused", f"{path}: has {n_frames} frames, its {len(numbers)} episodes need {needed}."
            )
        if fps != meta.fps:
            yield Said("refused", f"{path}: has {fps} frames per second, expected {meta.fps}.")


def _statistics(dataset: LocalDataset, demonstrations: Demonstrations) -> Iterator[Said]:
    """Compare `meta/stats.json` with the rows; a conversion and an adoption compute it from them."""
    stored = dataset.meta.stats or {}
    differing = []
    for name, rows in demonstrations.columns.items():
        values = rows.reshape(len(rows), -1).astype(np.float64)
        computed = {kind: getattr(values, kind)(axis=0) for kind in STATISTICS}
        known = stored.get(name, {})
        for kind, expected in computed.items():
            found = np.asarray(known.get(kind, np.nan), dtype=np.float64).reshape(-1)
            scale = np.abs(values).max(axis=0) + 1e-12
            if (
                found.shape != expected.shape
                or not (np.abs(found - expected) <= STATISTICS_TOLERANCE * scale).all()
            ):
                differing.append(f"{kind} of {name}")
                break
    if differing:
        yield Said(
            "kept",
            f"meta/stats.json differs from the rows: {', '.join(differing)}. `dataset adopt` and "
            "`dataset convert` compute it again.",
        )
