"""The files in `meta/mikasa/`, next to lerobot's own: which episodes these are, and proof of it.

    manifest.jsonl  one `RecordedEpisode` per episode: enough to make the episode again
    failed.jsonl    one `FailedSeed` per seed at which the expert did not succeed
    recording.json  recipe, environment, counts, digest of every file; written last (see `facts`)
    replay.json     `ReplayReport`: what a replay of the stored actions found

An imported dataset has `import.json` instead, one that was mixed of several `mixture.json`, one of
demonstrations on an arm `arm.json` and, in `failed.jsonl`, a `DiscardedTrial` per episode that was not kept.

A folder of its own, because lerobot drops keys of `info.json` that it does not know. Standard library
and numpy only: it knows nothing of lerobot.
"""

import base64
import binascii
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.core import EpisodeStart, FloatArray
from vla_eval.data.folder_contents import check_folder
from vla_eval.errors import DatasetError
from vla_eval.robots.find import action_of
from vla_eval.storage.durable import replace_file, whole_lines
from vla_eval.strict.json_text import (
    Count,
    Positive,
    Source,
    as_dataclass,
    read_file,
    read_json,
    read_version,
)

FORMAT_VERSION = 1
"""Of the files below. Raise it when a field changes its meaning; readers refuse versions they do not know."""

MIKASA_FOLDER = Path("meta/mikasa")
MANIFEST_FILE = MIKASA_FOLDER / "manifest.jsonl"
FAILED_FILE = MIKASA_FOLDER / "failed.jsonl"
RECORDING_FILE = MIKASA_FOLDER / "recording.json"
REPLAY_FILE = MIKASA_FOLDER / "replay.json"
IMPORT_FILE = MIKASA_FOLDER / "import.json"
MIXTURE_FILE = MIKASA_FOLDER / "mixture.json"
ARM_FILE = MIKASA_FOLDER / "arm.json"

FETCH_AGAIN = "The file was changed by another program; fetch or record the dataset again."


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEpisode:
    """One demonstration: an episode is a function of (task, arguments, seed, actions)."""

    episode_index: Count
    task: str
    task_version: Positive
    env_kwargs: dict[str, Any]  # Any: whatever the task's arguments are
    seed: Count
    instruction: str
    expert: str
    expert_version: Positive
    # `cue_steps`, `delay_steps`: lengths of the first two phases, in control steps
    cue_steps: Count
    delay_steps: Count
    n_steps: Positive  # number of frames, one per control step
    # control steps executed when the success rule first held; None if it never did
    success_step: Positive | None
    actions: str  # the executed actions, (n_steps, A) float32, as `encode_actions` writes them
    intended_actions: str | None  # what the expert asked for before noise was added; None without noise
    # digest of all states from reset to the end, see `states_digest` in `demonstrations`
    states_sha256: str
    # camera -> digest of its raw frames, (n_steps, H, W, 3) uint8, before encoding
    images_sha256: dict[str, str]

    def action_rows(self) -> FloatArray:
        """Return the executed actions, (n_steps, A) float32."""
        return decode_actions(self.actions, n_dims=self._n_action_dims)

    def intended_rows(self) -> FloatArray | None:
        """Return the actions before noise was added, (n_steps, A) float32; None without noise."""
        if self.intended_actions is None:
            return None
        return decode_actions(self.intended_actions, n_dims=self._n_action_dims)

    def start(self) -> EpisodeStart:
        """Return the episode, to be done again in slot 0."""
        return EpisodeStart(
            slot=0,
            task=self.task,
            seed=self.seed,
            run=0,
            instruction=self.instruction,
            horizon_steps=self.n_steps,
        )

    @property
    def _n_action_dims(self) -> int:
        return len(action_of(self.env_kwargs).dims)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmEpisode:
    """One demonstration on an arm: how the table was set, its phases, and what the operator marked."""

    number: Positive  # of its trial in the plan
    seed: Count  # of the trial
    instruction: str
    color: str  # of the right cube
    places: tuple[Count, ...]  # of each cube, from the arm's right, in the order of `real_stages.COLORS`
    cue_steps: Count
    delay_steps: Count
    n_steps: Positive
    # control steps executed when the right cube was marked as picked; None if it never was
    success_step: Positive | None
    touched: tuple[str, ...]  # colours, in the order in which they were marked


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscardedTrial:
    """A trial on an arm whose episode was not kept."""

    number: Positive  # in the plan
    n_steps: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedSeed:
    """A seed below the last kept one at which the expert did not succeed within the horizon."""

    seed: Count
    n_steps: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class FileDigest:
    """Size and sha256 of one file of the dataset."""

    n_bytes: Count
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayReport:
    """What a replay found; `finetune` asks for `passed`."""

    passed: bool
    n_episodes: Count  # episodes replayed; n_total: episodes of the dataset
    n_total: Count
    pixels: bool  # whether images were compared, too
    states_compared: str  # `bit-equal`, or the tolerance where environments differ
    mismatches: tuple[str, ...]
    # camera -> how close the video comes to the rendered frames in the worst episode; empty where images
    # were not compared
    lowest_psnr_db: dict[str, float]
    # digest of the manifest that was replayed; another manifest needs another replay
    manifest_sha256: str
    environment: dict[str, Any] = field(default_factory=dict)  # Any: plain data


def encode_actions(actions: FloatArray) -> str:
    """Return (n, A) float32 as text: base64 of the little-endian bytes, row by row; exact."""
    return base64.b64encode(np.ascontiguousarray(actions, dtype="<f4").tobytes()).decode("ascii")


def decode_actions(text: str, *, n_dims: int) -> FloatArray:
    """Return what `encode_actions` was given, or raise `DatasetError`."""
    try:
        rows = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f4").reshape(-1, n_dims)
    except (binascii.Error, ValueError) as exc:
        raise DatasetError(
            f"actions: expected base64 of float32 rows of {n_dims}, found {text[:40]!r} ({exc})."
        ) from exc
    return rows.astype(np.float32)


def to_json(entry: Any, *, indent: int | None = None) -> str:  # Any: dataclasses have no common type
    """Return a dataclass as JSON with the format's version."""
    data = {"format_version": FORMAT_VERSION, **dataclasses.asdict(entry)}
    return json.dumps(data, ensure_ascii=False, allow_nan=False, indent=indent)


def from_json[E](cls: type[E], text: str | bytes, *, where: str) -> E:
    """Return the entry that `to_json` wrote; raise `DatasetError` for another one, or another version."""
    source = Source(where=where, what=f"a {cls.__name__}", remedy=FETCH_AGAIN, error=DatasetError)
    data = read_json(text, source)
    read_version(data, "format_version", FORMAT_VERSION, source)
    return as_dataclass(cls, data, source)


type Entry = RecordedEpisode | ArmEpisode | DiscardedTrial | FailedSeed
"""What the files with one entry per line hold."""


def write_lines(path: Path, entries: Sequence[Entry]) -> None:
    """Write entries, one per line, whole or not at all."""
    replace_file(path, "".join(f"{to_json(entry)}\n" for entry in entries))


def write_entry(path: Path, entry: Any) -> None:  # Any: dataclasses have no common type
    """Write a file with one entry, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, f"{to_json(entry, indent=2)}\n")


def read_manifest(dataset: Path) -> tuple[RecordedEpisode, ...]:
    """Return the episodes of a dataset, in the order of their numbers, or raise `DatasetError`."""
    check_folder(dataset)
    episodes = read_entries(dataset / MANIFEST_FILE, RecordedEpisode)
    numbers = [episode.episode_index for episode in episodes]
    if numbers != list(range(len(episodes))):
        raise DatasetError(
            f"{dataset / MANIFEST_FILE}: expected episodes 0, 1, 2 …, found {numbers[:10]} …. {FETCH_AGAIN}"
        )
    return episodes


def read_failed(dataset: Path) -> tuple[FailedSeed, ...]:
    """Return the seeds at which the expert failed; errors as `read_manifest`."""
    return read_entries(dataset / FAILED_FILE, FailedSeed)


def read_replay(dataset: Path) -> ReplayReport | None:
    """Return what the last replay found; None if there was none."""
    path = dataset / REPLAY_FILE
    return from_json(ReplayReport, read_content(path), where=str(path)) if path.exists() else None


def read_entries[E: Entry](path: Path, cls: type[E]) -> tuple[E, ...]:
    """Return the entries of a file, one per line; raise `DatasetError` if it is missing or damaged."""
    data = read_content(path)
    if data and not data.endswith(b"\n"):
        raise DatasetError(f"{path}: expected a line end at its end; the last line is torn. {FETCH_AGAIN}")
    return tuple(from_json(cls, line, where=where) for line, where in whole_lines(data, path))


def read_content(path: Path) -> bytes:
    """Return what a file of `meta/mikasa/` holds, or raise `DatasetError`."""
    remedy = "Name the folder of one task, OUT/TASK, that `mikasa-vla record` has finished."
    try:
        return read_file(path, Source(where=str(path), what="a file", remedy=remedy, error=DatasetError))
    except (FileNotFoundError, NotADirectoryError) as exc:
        if path.with_name(MIXTURE_FILE.name).is_file():
            raise DatasetError(
                f"{path}: is not there: this dataset was mixed of several, which {MIXTURE_FILE} names. Name "
                f"one of those."
            ) from exc
        raise DatasetError(
            f"{path}: is not there: it is not a dataset that `mikasa-vla record` has finished. Name the "
            f"folder of one task, OUT/TASK."
        ) from exc


def keep_report(dataset: Path, report: ReplayReport) -> None:
    """Write the report, unless one that is there says more: of all episodes, of images, or a mismatch."""
    if report.passed:
        before = read_replay(dataset)
        hides = (
            before is not None
            and before.manifest_sha256 == report.manifest_sha256
            and not before.passed
            and before.pixels
            and not report.pixels
        )
        if hides or report.n_episodes < report.n_total:
            return
    write_entry(dataset / REPLAY_FILE, report)


def require_passed(dataset: Path, report: ReplayReport | None, manifest: str) -> ReplayReport | None:
    """Return the report of a dataset's last replay, as `read_replay` returned it."""
    if report is None:
        return None
    if report.manifest_sha256 != manifest:
        raise DatasetError(
            f"{dataset}: {REPLAY_FILE} is about another manifest. Replay the dataset: mikasa-vla replay "
            f"{dataset}"
        )
    if not report.passed:
        shown = "\n".join(f"  {sentence}" for sentence in report.mismatches[:5])
        raise DatasetError(
            f"{dataset}: its replay failed with {len(report.mismatches)} mismatches:\n{shown}\nWhat is "
            f"learned from it would not fit the environment. Record it again, or rebuild it from its "
            f"manifest: mikasa-vla replay {dataset} --rebuild OUT"
        )
    return report


def needs_replay(dataset: Path) -> bool:
    """Whether no replay of the whole dataset, as it is, has passed."""
    report = read_replay(dataset)
    return report is None or not report.passed or report.manifest_sha256 != manifest_sha256(dataset)


def manifest_sha256(dataset: Path) -> str:
    """Return the digest of a dataset's manifest."""
    return hashlib.sha256((dataset / MANIFEST_FILE).read_bytes()).hexdigest()
