"""What lies in `meta/mikasa/` beside lerobot's own files: which episodes these are, and proof of it.

    manifest.jsonl  one `RecordedEpisode` per episode: enough to make the episode again
    failed.jsonl    one `FailedSeed` per seed at which the expert did not succeed
    recording.json  `DatasetFacts`: recipe, environment, counts, digest of every file; written last
    replay.json     `ReplayReport`: what a replay of the stored actions found

An imported dataset has `import.json` instead (`imported`), one that was mixed of several has `mixture.json`.

A folder of its own, because lerobot drops keys of `info.json` that it does not know. Standard library
and numpy only: it knows nothing of lerobot.
"""

import base64
import binascii
import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from vla_eval.control_modes import action_spec, control_mode_of
from vla_eval.core import FloatArray
from vla_eval.data.folder_contents import check_folder
from vla_eval.errors import DatasetError
from vla_eval.storage.durable import replace_file
from vla_eval.strict.json_text import (
    Count,
    Positive,
    Source,
    as_dataclass,
    read_file,
    read_json,
    read_version,
    shown,
)

FORMAT_VERSION = 1
"""Of the files below. Raise it when a field changes its meaning; readers refuse versions they do not know."""

MIKASA_FOLDER = Path("meta/mikasa")
MANIFEST_FILE = MIKASA_FOLDER / "manifest.jsonl"
FAILED_FILE = MIKASA_FOLDER / "failed.jsonl"
RECORDING_FILE = MIKASA_FOLDER / "recording.json"
REPLAY_FILE = MIKASA_FOLDER / "replay.json"
MIXTURE_FILE = MIKASA_FOLDER / "mixture.json"

FETCH_AGAIN = "The file was changed by another program; fetch or record the dataset again."
MAX_NAME = 255  # bytes; what file systems take


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEpisode:
    """One demonstration: an episode is a function of (task, arguments, seed, actions).

    Attributes:
        episode_index: its number in the dataset.
        task, task_version, env_kwargs, seed: what the environment is made and reset with.
        instruction: the language instruction.
        expert, expert_version: the policy recipe that acted.
        cue_steps, delay_steps: lengths of the first two phases, in control steps.
        n_steps: number of frames, one per control step.
        success_step: control steps executed when the success rule first held; None if it never did.
        actions: the executed actions, (n_steps, A) float32, as `encode_actions` writes them.
        intended_actions: what the expert asked for before noise was added; None without noise.
        states_sha256: digest of all states from reset to the end, see `states_digest` in `demonstrations`.
        images_sha256: camera -> digest of its raw frames, (n_steps, H, W, 3) uint8, before encoding.
    """

    episode_index: Count
    task: str
    task_version: Positive
    env_kwargs: dict[str, Any]  # Any: whatever the task's arguments are
    seed: Count
    instruction: str
    expert: str
    expert_version: Positive
    cue_steps: Count
    delay_steps: Count
    n_steps: Positive
    success_step: Positive | None
    actions: str
    intended_actions: str | None
    states_sha256: str
    images_sha256: dict[str, str]

    def action_rows(self) -> FloatArray:
        """Return the executed actions, (n_steps, A) float32."""
        return decode_actions(self.actions, n_dims=self._n_action_dims)

    def intended_rows(self) -> FloatArray | None:
        """Return the actions before noise was added, (n_steps, A) float32; None without noise."""
        if self.intended_actions is None:
            return None
        return decode_actions(self.intended_actions, n_dims=self._n_action_dims)

    @property
    def _n_action_dims(self) -> int:
        return len(action_spec(control_mode_of(self.env_kwargs)).dims)


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
class DatasetFacts:
    """What the dataset is, and how it came about; its presence with `complete` marks it as finished.

    Attributes:
        complete: written as true, after everything else.
        name: the recipe's name.
        task, task_version, instruction: the one task of the dataset.
        state: which proprioception `observation.state` is.
        n_episodes, n_frames, n_failed_seeds: counts.
        recipe: the resolved recipe; `recipe_sha256` is the digest of the part that content depends on.
        recipe_files: `policies/oracle` -> sha256 of the file; likewise the prompts, and the weights of a
            learned expert.
        environment: commit, versions and machine, see `provenance.collect_environment`.
        device: what the environment says of the device it rendered on.
        files: path below the dataset -> digest; lerobot's files and the manifest.
    """

    complete: bool
    name: str
    task: str
    task_version: Positive
    instruction: str
    state: str
    n_episodes: Count
    n_frames: Count
    n_failed_seeds: Count
    recipe: dict[str, Any]  # Any: plain data
    recipe_sha256: str
    recipe_files: dict[str, str]
    environment: dict[str, Any]  # Any: plain data
    device: dict[str, str]
    files: dict[str, FileDigest]

    @property
    def control_mode(self) -> str:
        """What the actions mean."""
        env = self.recipe.get("env")
        return control_mode_of(env if isinstance(env, dict) else {})


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayReport:
    """What a replay found; `finetune` asks for `passed`.

    Attributes:
        passed: every episode that was replayed is what the manifest says.
        n_episodes: episodes replayed; n_total: episodes of the dataset.
        pixels: whether images were compared, too.
        states_compared: `bit-equal`, or the tolerance where environments differ.
        mismatches: one sentence each.
        lowest_psnr_db: camera -> how close the video comes to the rendered frames in the worst episode;
            empty where images were not compared.
        manifest_sha256: digest of the manifest that was replayed; another manifest needs another replay.
        environment: where it was replayed.
    """

    passed: bool
    n_episodes: Count
    n_total: Count
    pixels: bool
    states_compared: str
    mismatches: tuple[str, ...]
    lowest_psnr_db: dict[str, float]
    manifest_sha256: str
    environment: dict[str, Any] = field(default_factory=dict)  # Any: plain data


type Entry = RecordedEpisode | FailedSeed | DatasetFacts | ReplayReport


def encode_actions(actions: FloatArray) -> str:
    """Return (n, A) float32 as text: base64 of the little-endian bytes, row by row; exact."""
    return base64.b64encode(np.ascontiguousarray(actions, dtype="<f4").tobytes()).decode("ascii")


def decode_actions(text: str, *, n_dims: int) -> FloatArray:
    """Return what `encode_actions` was given.

    Raises:
        DatasetError: the text is no such thing.
    """
    try:
        rows = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f4").reshape(-1, n_dims)
    except (binascii.Error, ValueError) as exc:
        raise DatasetError(
            f"actions: expected base64 of float32 rows of {n_dims}, found {text[:40]!r} ({exc})."
        ) from exc
    return rows.astype(np.float32)


def to_json(entry: Entry, *, indent: int | None = None) -> str:
    """Return an entry as JSON with the format's version."""
    data = {"format_version": FORMAT_VERSION, **dataclasses.asdict(entry)}
    return json.dumps(data, ensure_ascii=False, allow_nan=False, indent=indent)


def from_json[E: Entry](cls: type[E], text: str | bytes, *, where: str) -> E:
    """Return the entry that `to_json` wrote.

    Raises:
        DatasetError: it is something else, or of another version.
    """
    source = Source(where=where, what=f"a {cls.__name__}", remedy=FETCH_AGAIN, error=DatasetError)
    data = read_json(text, source)
    read_version(data, "format_version", FORMAT_VERSION, source)
    return as_dataclass(cls, data, source)


def write_lines(path: Path, entries: Sequence[RecordedEpisode | FailedSeed]) -> None:
    """Write entries, one per line, whole or not at all."""
    replace_file(path, "".join(f"{to_json(entry)}\n" for entry in entries))


def write_entry(path: Path, entry: DatasetFacts | ReplayReport) -> None:
    """Write one entry, whole or not at all."""
    replace_file(path, f"{to_json(entry, indent=2)}\n")


def read_manifest(dataset: Path) -> tuple[RecordedEpisode, ...]:
    """Return the episodes of a dataset, in the order of their numbers.

    Raises:
        DatasetError: there is no manifest, or it is damaged.
    """
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


def read_facts(dataset: Path) -> DatasetFacts:
    """Return what the dataset is.

    Raises:
        DatasetError: there is no `recording.json`, it is damaged, or the dataset is not complete.
    """
    check_folder(dataset)
    path = dataset / RECORDING_FILE
    facts = from_json(DatasetFacts, _content(path), where=str(path))
    check_file_names(facts.files, where=path)
    if not facts.complete:
        raise DatasetError(f"{dataset}: is not complete. Run the command that records it again: it resumes.")
    return facts


def read_replay(dataset: Path) -> ReplayReport | None:
    """Return what the last replay found; None if there was none.

    Raises:
        DatasetError: the file is damaged.
    """
    path = dataset / REPLAY_FILE
    return from_json(ReplayReport, _content(path), where=str(path)) if path.exists() else None


def check_file_names(files: Mapping[str, FileDigest], *, where: Path) -> None:
    """Raise `DatasetError` unless every name is a path inside of the dataset.

    Args:
        files: path below the dataset -> digest.
        where: the file that names them, for the message.
    """
    for name in files:
        parts = PurePosixPath(name).parts
        is_inside = bool(parts) and not name.startswith("/") and ".." not in parts
        if not is_inside or not name.isprintable() or max(len(part.encode()) for part in parts) > MAX_NAME:
            raise DatasetError(
                f"{where}: expected names of files inside of the dataset, found {shown(name)}. {FETCH_AGAIN}"
            )


def read_entries[E: RecordedEpisode | FailedSeed](path: Path, cls: type[E]) -> tuple[E, ...]:
    """Return the entries of a file, one per line.

    Raises:
        DatasetError: there is no such file, or a line is damaged.
    """
    lines = _content(path).split(b"\n")
    if lines[-1]:
        raise DatasetError(f"{path}: expected a line end at its end; the last line is torn. {FETCH_AGAIN}")
    return tuple(from_json(cls, line, where=f"{path}:{i}") for i, line in enumerate(lines[:-1], start=1))


def _content(path: Path) -> bytes:
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
            f"{path}: is not there: this is no dataset that `mikasa-vla record` has finished. Name the "
            f"folder of one task, OUT/TASK."
        ) from exc
