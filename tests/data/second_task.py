"""A dataset of another task that counts as recorded, beside the fixture `recorded`."""

import dataclasses
import functools
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from vla_eval.data.dataset_folder import digest_files
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import (
    FAILED_FILE,
    MANIFEST_FILE,
    MIKASA_FOLDER,
    RECORDING_FILE,
    read_manifest,
    write_entry,
    write_lines,
)
from vla_eval.features import StateKind
from vla_eval.testing.synthetic import write_synthetic_dataset

TASK, SENTENCE = "ShellGameTouch-v0", "touch the cup"


@functools.cache
def _frames(state: StateKind, sentence: str) -> TemporaryDirectory[str]:
    """Encode the videos once per process."""
    folder = TemporaryDirectory()
    Path(folder.name).rmdir()  # lerobot wants to make it
    write_synthetic_dataset(
        Path(folder.name), n_episodes=2, n_frames=13, state=state, seed=1, instructions=[sentence]
    )
    return folder


def write_second_task(recorded: Path, *, state: StateKind = "eef", sentence: str = SENTENCE) -> Path:
    """Write 2 episodes of 13 and 14 frames, of seeds 2000 and 2001, beside a recorded dataset."""
    root = recorded.parent / TASK
    shutil.copytree(_frames(state, sentence).name, root)
    (root / MIKASA_FOLDER).mkdir()
    like = zip(read_manifest(recorded)[:2], (2000, 2001), strict=True)
    episodes = [dataclasses.replace(e, task=TASK, instruction=sentence, seed=seed) for e, seed in like]
    write_lines(root / MANIFEST_FILE, episodes)
    write_lines(root / FAILED_FILE, [])
    facts = dataclasses.replace(
        read_facts(recorded),
        task=TASK,
        instruction=sentence,
        state=state,
        n_episodes=2,
        n_frames=27,
        n_failed_seeds=0,
        files=digest_files(root),
    )
    write_entry(root / RECORDING_FILE, facts)
    return root
