"""Random lines and files in `meta/mikasa/` of a dataset: they are accepted, or refused with a message."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.json_cases import BYTES, VALUES, accepted_or_refused, as_bytes, near
from vla_eval.data.dataset_folder import check_dataset
from vla_eval.data.facts import (
    ArmFacts,
    DatasetFacts,
    ImportedEpisode,
    ImportFacts,
    MixtureFacts,
    MixtureSource,
    find_facts,
)
from vla_eval.data.info_file import INFO_FILE, read_info
from vla_eval.data.manifest import (
    ARM_FILE,
    FAILED_FILE,
    IMPORT_FILE,
    MANIFEST_FILE,
    MIKASA_FOLDER,
    MIXTURE_FILE,
    RECORDING_FILE,
    REPLAY_FILE,
    ArmEpisode,
    FailedSeed,
    FileDigest,
    RecordedEpisode,
    ReplayReport,
    encode_actions,
    read_entries,
    read_failed,
    read_manifest,
    read_replay,
    to_json,
)
from vla_eval.data.recording.shard_writer import SHARD_EPISODES

EMPTY = FileDigest(n_bytes=0, sha256="e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855")
EPISODE = RecordedEpisode(
    episode_index=0,
    task="RememberColor3-v0",
    task_version=1,
    env_kwargs={"delay_steps": 5},
    seed=1000,
    instruction="reach it\u2028now",  # a line separator, which ends no line of JSON
    expert="oracle",
    expert_version=1,
    cue_steps=5,
    delay_steps=5,
    n_steps=2,
    success_step=2,
    actions=encode_actions(np.zeros((2, 7), dtype=np.float32)),
    intended_actions=None,
    states_sha256="ab",
    images_sha256={"base_camera": "cd"},
)
FACTS = DatasetFacts(
    complete=True,
    name="demo",
    task="RememberColor3-v0",
    task_version=1,
    instruction="reach it",
    state="qpos",
    n_episodes=1,
    n_frames=2,
    n_failed_seeds=1,
    recipe={"tasks": ["RememberColor3-v0"]},
    recipe_sha256="ab",
    recipe_files={"policies/oracle": "cd"},
    environment={"python": "3.12.1"},
    device={"simulator": "fake"},
    files={"meta/info.json": EMPTY},
)
REPORT = ReplayReport(
    passed=True,
    n_episodes=1,
    n_total=1,
    pixels=True,
    states_compared="bit-equal",
    mismatches=(),
    lowest_psnr_db={"base_camera": 40.0},
    manifest_sha256="ab",
)
IMPORT = ImportFacts(
    complete=True,
    source_layout="npz_joints",
    task=None,
    instruction_source="source",
    state="qpos",
    control_mode="pd_joint_pos",
    executable_by_pd_ee_delta_pose=False,
    absent=("seed",),
    left_out=(),
    n_frames=2,
    episodes=(ImportedEpisode(name="0", n_steps=2, instruction="x", source_seed=None, success=True),),
    source_files={"a.npz": EMPTY},
    files={"meta/info.json": EMPTY},
    vla_eval_version="1",
)
SOURCE = MixtureSource(
    name="demo",
    task=None,
    task_version=1,
    instructions=("x",),
    n_episodes=1,
    n_frames=2,
    sha256="ab",
    seeds=(1000,),
    failed_seeds=(),
    was_replayed=False,
)
MIXTURE = MixtureFacts(
    complete=True,
    state="eef",
    control_mode="pd_joint_pos",
    sources=(SOURCE,),
    files={"meta/info.json": EMPTY},
    vla_eval_version="1",
)
TRIAL = ArmEpisode(
    number=3,
    seed=3001,
    instruction="pick it",
    color="red",
    places=(0, 1, 2),
    cue_steps=21,
    delay_steps=0,
    n_steps=2,
    success_step=None,
    touched=("green",),
)
ARM = ArmFacts(
    complete=True,
    task="real/CubeVisible-v0",
    robot="so101_follower",
    settings={"max_step": 5},
    leader="so101_leader",
    teleop={"port": "/dev/ttyACM1"},
    n_frames=2,
    n_discarded=1,
    episodes=(TRIAL,),
    environment={"python": "3.12.1"},
    files={"meta/info.json": EMPTY},
    vla_eval_version="1",
)
FEATURE = {"dtype": "video", "shape": [128, 128, 3], "names": None}
INFO = {
    **{"codebase_version": "v3.0", "robot_type": "panda", "fps": 20, "total_episodes": 1, "total_frames": 2},
    **{"chunks_size": 1000, "features": {"observation.images.base": FEATURE}, "splits": {"train": "0:1"}},
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
WRITTEN: dict[Path, dict[str, Any]] = {
    INFO_FILE: INFO,
    MANIFEST_FILE: json.loads(to_json(EPISODE)),
    FAILED_FILE: json.loads(to_json(FailedSeed(seed=7, n_steps=60))),
    RECORDING_FILE: json.loads(to_json(FACTS)),
    REPLAY_FILE: json.loads(to_json(REPORT)),
    IMPORT_FILE: json.loads(json.dumps({"format_version": 1, **dataclasses.asdict(IMPORT)})),
    MIXTURE_FILE: json.loads(json.dumps({"format_version": 1, **dataclasses.asdict(MIXTURE)})),
    ARM_FILE: json.loads(to_json(ARM)),
}
READERS: dict[Path, Callable[[Path], object]] = {
    MANIFEST_FILE: lambda root: [episode.action_rows() for episode in read_manifest(root)],
    FAILED_FILE: read_failed,
    RECORDING_FILE: check_dataset,
    REPLAY_FILE: read_replay,
    IMPORT_FILE: find_facts,
    MIXTURE_FILE: find_facts,
    ARM_FILE: find_facts,
    INFO_FILE: read_info,
}
FILES = st.dictionaries(
    st.sampled_from(("meta/info.json", "../x", "/etc/passwd", "a/../../x", "", ".", "a" * 300, "\0", "a\nb")),
    near({"n_bytes": 0, "sha256": EMPTY.sha256}) | VALUES,
    max_size=2,
)


def changed(name: Path) -> st.SearchStrategy[Any]:
    data = WRITTEN[name]
    return near(data) | FILES.map(lambda files: {**data, "files": files}) | VALUES


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A dataset as far as these files go."""
    (tmp_path / MIKASA_FOLDER).mkdir(parents=True)
    (tmp_path / INFO_FILE).touch()
    return tmp_path


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (FAILED_FILE, (FailedSeed(seed=7, n_steps=60),)),
        (RECORDING_FILE, FACTS),
        (REPLAY_FILE, REPORT),
        (IMPORT_FILE, IMPORT),
        (MIXTURE_FILE, MIXTURE),
        (ARM_FILE, ARM),
        (INFO_FILE, INFO),
    ],
    ids=str,
)
def test_what_is_valid_is_accepted(root: Path, name: Path, expected: object) -> None:
    (root / name).write_text(json.dumps(WRITTEN[name]) + "\n")
    assert READERS[name](root) == expected


def test_a_line_separator_within_a_sentence_ends_no_line(root: Path) -> None:
    (root / MANIFEST_FILE).write_text(to_json(EPISODE) + "\n")
    assert read_manifest(root) == (EPISODE,)


def test_a_shard_with_such_a_sentence_is_read(root: Path) -> None:
    (root / SHARD_EPISODES).write_text(to_json(EPISODE) + "\n")
    assert read_entries(root / SHARD_EPISODES, RecordedEpisode) == (EPISODE,)


@pytest.mark.sampled(3)
@given(data=st.data())
@pytest.mark.parametrize("name", WRITTEN, ids=str)
def test_other_json_is_accepted_or_refused_with_a_message(root: Path, name: Path, data: Any) -> None:
    (root / name).write_bytes(as_bytes(data.draw(changed(name))) + b"\n")
    accepted_or_refused(lambda: READERS[name](root))


@given(content=BYTES, cut=st.integers(min_value=0, max_value=600))
@pytest.mark.parametrize("name", WRITTEN, ids=str)
def test_other_bytes_are_accepted_or_refused_with_a_message(
    root: Path, name: Path, content: bytes, cut: int
) -> None:
    whole = as_bytes(WRITTEN[name]) + b"\n"
    for damaged in (content, whole[:cut] + content + whole[cut + 1 :]):
        (root / name).write_bytes(damaged)
        accepted_or_refused(lambda: READERS[name](root))


@pytest.mark.parametrize("file", ["../x", "/etc/passwd", "a/../../x", "", "a" * 300, "\0", "a\nb"])
@pytest.mark.parametrize("name", [RECORDING_FILE, IMPORT_FILE, MIXTURE_FILE], ids=str)
def test_a_file_outside_of_the_dataset_is_not_looked_at(root: Path, name: Path, file: str) -> None:
    data = {**WRITTEN[name], "files": {file: dataclasses.asdict(EMPTY)}}
    (root / name).write_bytes(as_bytes(data))
    with pytest.raises(Exception, match="expected names of files inside of the dataset") as caught:
        READERS[name](root)
    assert type(caught.value).__name__ == "DatasetError"
