"""`meta/mikasa/import.json`: where a converted dataset came from, and what it does not have.

A dataset that was recorded here has `recording.json` instead (`manifest`). Knows nothing of lerobot.
"""

from dataclasses import dataclass
from pathlib import Path

from vla_eval.data.facts_file import FactsFile
from vla_eval.data.manifest import MIKASA_FOLDER, FileDigest
from vla_eval.strict.json_text import Count, Positive

IMPORT_FILE = MIKASA_FOLDER / "import.json"
FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedEpisode:
    """What the source says of an episode.

    Attributes:
        name: its file, or its number in the source.
        n_steps: number of frames.
        instruction: the language instruction.
        source_seed: its seed in the source's environment; ours gives another episode for it.
        success: whether the source's success flag holds at any frame; None if it has none.
    """

    name: str
    n_steps: Positive
    instruction: str
    source_seed: int | None
    success: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportFacts:
    """What a converted dataset is; its presence with `complete` marks it as finished.

    Attributes:
        complete: written as true, after everything else.
        source_layout: `npz_joints`, `npz_proprio`, `lerobot_official`, `lerobot_suite90`, `lerobot_mikasa`;
            or `adopted`, if the files are those of the source.
        task: the task id that the user named; None if none was.
        instruction_source: where the instruction comes from: `source`, or the prompt set of that task.
        state: which proprioception `observation.state` is.
        control_mode: what the actions are for.
        executable_by_pd_ee_delta_pose: whether this project's environments can execute them.
        absent: fields of our own datasets that the source does not have.
        left_out: arrays of the source that were not taken over.
        n_frames: of all episodes.
        episodes: what the source says of each.
        source_files: path below the source -> digest.
        files: path below the dataset -> digest.
        vla_eval_version: what converted it.
        is_checked: whether the rules of `checks.rules` were applied; False for what an older version wrote.
        converted: what was changed because it was asked for, a sentence each.
        kept: what differs from what is expected, or is assumed, and was kept.
    """

    complete: bool
    source_layout: str
    task: str | None
    instruction_source: str
    state: str
    control_mode: str
    executable_by_pd_ee_delta_pose: bool
    absent: tuple[str, ...]
    left_out: tuple[str, ...]
    n_frames: Count
    episodes: tuple[ImportedEpisode, ...]
    source_files: dict[str, FileDigest]
    files: dict[str, FileDigest]
    vla_eval_version: str
    is_checked: bool = False
    converted: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()


_FILE = FactsFile(
    cls=ImportFacts,
    path=IMPORT_FILE,
    version=FORMAT_VERSION,
    what="what a conversion says of a dataset",
    made_by="the conversion",
    remedy="convert the source again.",
)


def write_import(dataset: Path, facts: ImportFacts) -> None:
    """Write `import.json`, whole or not at all."""
    _FILE.write(dataset, facts)


def read_import(dataset: Path) -> ImportFacts | None:
    """Return where a dataset was converted from; None if it was not.

    Raises:
        DatasetError: the file is damaged, of another version, or the conversion did not finish.
    """
    return _FILE.read(dataset)
