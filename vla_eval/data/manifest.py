"""What lies in `meta/mikasa/` beside lerobot's own files: which episodes these are, and proof of it.

    manifest.jsonl  one `RecordedEpisode` per episode: enough to make the episode again
    failed.jsonl    one `FailedSeed` per seed at which the expert did not succeed
    recording.json  `DatasetFacts`: recipe, environment, counts, digest of every file; written last
    replay.json     `ReplayReport`: what a replay of the stored actions found

A folder of its own, because lerobot drops keys of `info.json` that it does not know. Standard library
and numpy only: it knows nothing of lerobot.
"""

import base64
import binascii
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vla_eval.config.decoding import decode
from vla_eval.core import FloatArray
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.storage.durable import replace_file

FORMAT_VERSION = 1
"""Of the files below. Raise it when a field changes its meaning; readers refuse versions they do not know."""

MIKASA_FOLDER = Path("meta/mikasa")
MANIFEST_FILE = MIKASA_FOLDER / "manifest.jsonl"
FAILED_FILE = MIKASA_FOLDER / "failed.jsonl"
RECORDING_FILE = MIKASA_FOLDER / "recording.json"
REPLAY_FILE = MIKASA_FOLDER / "replay.json"


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
        actions: the executed actions, (n_steps, 7) float32, as `encode_actions` writes them.
        intended_actions: what the expert asked for before noise was added; None without noise.
        states_sha256: digest of all states from reset to the end, see `states_digest` in `demonstrations`.
        images_sha256: camera -> digest of its raw frames, (n_steps, H, W, 3) uint8, before encoding.
    """

    episode_index: int
    task: str
    task_version: int
    env_kwargs: dict[str, Any]  # Any: whatever the task's arguments are
    seed: int
    instruction: str
    expert: str
    expert_version: int
    cue_steps: int
    delay_steps: int
    n_steps: int
    success_step: int | None
    actions: str
    intended_actions: str | None
    states_sha256: str
    images_sha256: dict[str, str]

    def action_rows(self) -> FloatArray:
        """Return the executed actions, (n_steps, 7) float32."""
        return decode_actions(self.actions)


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedSeed:
    """A seed below the last kept one at which the expert did not succeed within the horizon."""

    seed: int
    n_steps: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FileDigest:
    """Size and sha256 of one file of the dataset."""

    n_bytes: int
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
    task_version: int
    instruction: str
    state: str
    n_episodes: int
    n_frames: int
    n_failed_seeds: int
    recipe: dict[str, Any]  # Any: plain data
    recipe_sha256: str
    recipe_files: dict[str, str]
    environment: dict[str, Any]  # Any: plain data
    device: dict[str, str]
    files: dict[str, FileDigest]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayReport:
    """What a replay found; `finetune` asks for `passed`.

    Attributes:
        passed: every episode that was replayed is what the manifest says.
        n_episodes: episodes replayed; n_total: episodes of the dataset.
        pixels: whether pictures were compared, too.
        states_compared: `bit-equal`, or the tolerance where environments differ.
        mismatches: one sentence each.
        lowest_psnr_db: camera -> how close the video comes to the rendered frames in the worst episode;
            empty where pictures were not compared.
        manifest_sha256: digest of the manifest that was replayed; another manifest needs another replay.
        environment: where it was replayed.
    """

    passed: bool
    n_episodes: int
    n_total: int
    pixels: bool
    states_compared: str
    mismatches: tuple[str, ...]
    lowest_psnr_db: dict[str, float]
    manifest_sha256: str
    environment: dict[str, Any] = field(default_factory=dict)  # Any: plain data


type Entry = RecordedEpisode | FailedSeed | DatasetFacts | ReplayReport


def encode_actions(actions: FloatArray) -> str:
    """Return (n, 7) float32 as text: base64 of the little-endian bytes, row by row; exact."""
    return base64.b64encode(np.ascontiguousarray(actions, dtype="<f4").tobytes()).decode("ascii")


def decode_actions(text: str, *, n_dims: int = 7) -> FloatArray:
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


def from_json[E: Entry](cls: type[E], text: str, *, where: str) -> E:
    """Return the entry that `to_json` wrote.

    Raises:
        DatasetError: it is something else, or of another version.
    """
    try:
        data: dict[str, Any] = json.loads(text)  # Any: JSON
        version = data.pop("format_version")
        if version == FORMAT_VERSION:
            return decode(cls, data, where=where)
    except (ValueError, KeyError, TypeError, AttributeError, RecipeError) as exc:
        raise DatasetError(
            f"{where}: expected a {cls.__name__}, found something else ({exc!r:.200}). The file was changed "
            f"by another program; fetch or record the dataset again."
        ) from exc
    raise DatasetError(
        f"{where}: format version {version}, this program reads version {FORMAT_VERSION}. Use the version "
        f"of mikasa-vla-eval that wrote it."
    )


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
    episodes = _read_lines(dataset / MANIFEST_FILE, RecordedEpisode)
    numbers = [episode.episode_index for episode in episodes]
    if numbers != list(range(len(episodes))):
        raise DatasetError(f"{dataset / MANIFEST_FILE}: expected episodes 0, 1, 2 …, found {numbers[:10]} ….")
    return episodes


def read_failed(dataset: Path) -> tuple[FailedSeed, ...]:
    """Return the seeds at which the expert failed; errors as `read_manifest`."""
    return _read_lines(dataset / FAILED_FILE, FailedSeed)


def read_facts(dataset: Path) -> DatasetFacts:
    """Return what the dataset is.

    Raises:
        DatasetError: there is no `recording.json`, it is damaged, or the dataset is not complete.
    """
    facts = from_json(DatasetFacts, _text(dataset / RECORDING_FILE), where=str(dataset / RECORDING_FILE))
    if not facts.complete:
        raise DatasetError(f"{dataset}: is not complete. Run the command that records it again: it goes on.")
    return facts


def read_replay(dataset: Path) -> ReplayReport | None:
    """Return what the last replay found; None if there was none.

    Raises:
        DatasetError: the file is damaged.
    """
    path = dataset / REPLAY_FILE
    return from_json(ReplayReport, _text(path), where=str(path)) if path.exists() else None


def _read_lines[E: RecordedEpisode | FailedSeed](path: Path, cls: type[E]) -> tuple[E, ...]:
    lines = _text(path).splitlines()
    return tuple(from_json(cls, line, where=f"{path}:{i}") for i, line in enumerate(lines, start=1))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise DatasetError(
            f"{path}: cannot be read ({exc}): this is no dataset that `mikasa-vla record` has finished. "
            f"Name the folder of one task, OUT/TASK."
        ) from exc
