"""Other people's datasets: right data, or one message that says what is wrong and where."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.data.foreign_datasets import (
    ASKED,
    CHANGES,
    FIRSTS,
    LENGTHS,
    N_FRAMES,
    Known,
    Tables,
    good_data,
    in_order,
    level_of,
    write_good,
)
from vla_eval.data.foreign.changes import Changes, prepare
from vla_eval.data.foreign.convert import convert_to_lerobot, find_source
from vla_eval.data.foreign.episodes import Source
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError

N_PAIRS, N_SINGLE = 75, 3  # of two kinds of dataset: 300 cases together


@pytest.fixture(scope="module", params=["video", "image"])
def good(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_good(tmp_path_factory.mktemp("foreign") / request.param, request.param)


def expect(known: Known, asked: Changes) -> Known:
    """Say what must follow from what was asked for; by hand, not by the code under test."""
    action = known.action.astype(np.float64)
    gripper = action[:, 6].copy()
    if asked.gripper is not None and asked.gripper != (-1, 1):
        closed, opened = asked.gripper
        action[:, 6] = np.interp(gripper, sorted((closed, opened)), (-1, 1) if opened > closed else (1, -1))
        if (gripper < 0).any() or (gripper > 1).any():  # outside of what was said: a line, not an end
            action[:, 6] = (2 * gripper - 1) * (1 if opened > closed else -1)
    elif asked.gripper is None and gripper.min() == 0 and gripper.max() <= 1:
        known.refusals.append("The gripper's commands")
    if asked.clip_actions:
        action = np.minimum(np.maximum(action, -1), 1)
    elif (np.abs(action) > 1 + 1e-4).any():
        known.refusals.append("the bounds of pd_ee_delta_pose")
    known.action = action.astype(np.float32)
    return known


def numbers(source: Source, name: str) -> np.ndarray:
    return np.concatenate([episode.numbers[name] for episode in source.episodes])


def read(root: Path, asked: Changes) -> Source:
    return prepare(find_source(root), asked)[0]


@pytest.mark.parametrize(
    "good", ["video", pytest.param("image", marks=pytest.mark.slow)], indirect=True, scope="module"
)
@settings(max_examples=N_PAIRS, derandomize=True, suppress_health_check=list(HealthCheck), deadline=None)
@given(data=st.data())
def test_any_dataset_is_read_right_or_refused_with_the_place(good: Path, data: st.DataObject) -> None:
    root = good.with_name("copy")
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(good, root)
    tables, known = Tables(root), good_data()
    names = data.draw(st.lists(st.sampled_from(sorted(CHANGES)), max_size=2, unique=True), label="changes")
    asked = ASKED[data.draw(st.sampled_from(sorted(ASKED)), label="asked")]
    for name in in_order(names):
        CHANGES[name](tables, known, data)
    tables.write()
    known = expect(known, asked)

    if known.refusals:
        with pytest.raises(DatasetError) as caught:
            read(root, asked)
        message = str(caught.value)
        assert any(words in message for words in known.refusals), message
        assert str(root) in message and len(message) < 3000
        return
    source = read(root, asked)
    np.testing.assert_allclose(numbers(source, "action"), known.action, atol=1e-6)
    np.testing.assert_array_equal(numbers(source, "proprio.xyz_rpy"), known.state)
    assert [one for episode in source.episodes for one in episode.sentences] == known.sentences
    assert list(source.left_out) == known.left_out
    if known.success is not None:
        assert numbers(source, "next.success").tolist() == known.success.tolist()
        assert numbers(source, "next.success").dtype == bool
    assert all(
        rows.dtype in (np.float32, bool) for episode in source.episodes for rows in episode.numbers.values()
    )


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", sorted(CHANGES))
@settings(max_examples=N_SINGLE, derandomize=True, suppress_health_check=list(HealthCheck), deadline=None)
@given(data=st.data())
def test_each_difference_alone_has_its_answer(good: Path, name: str, data: st.DataObject) -> None:
    root = good.with_name("copy")
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(good, root)
    tables, known = Tables(root), good_data()
    CHANGES[name](tables, known, data)
    tables.write()
    known = expect(known, Changes())
    if known.refusals:
        with pytest.raises(DatasetError, match="|".join(map(re.escape, known.refusals))):
            read(root, Changes())
    else:
        np.testing.assert_array_equal(numbers(read(root, Changes()), "action"), known.action)


def test_images_belong_to_their_frames(good: Path) -> None:
    for episode, first in zip(find_source(good).episodes, FIRSTS, strict=True):
        base, wrist = episode.read_images()
        rows = np.arange(first, first + episode.n_frames)
        levels = np.array([level_of(int(row)) for row in rows])
        assert np.abs(base.mean(axis=(1, 2, 3)) - levels).max() < 3  # video
        assert np.abs(wrist.mean(axis=(1, 2, 3)) - (255 - levels)).max() < 3


def test_a_conversion_writes_what_was_read(good: Path, tmp_path: Path) -> None:
    known = good_data()
    facts = convert_to_lerobot(find_source(good), tmp_path / "ours", state="eef")

    dataset = open_local_dataset(tmp_path / "ours")
    samples = [dataset[row] for row in range(N_FRAMES)]
    assert np.array_equal(np.stack([one["action"].numpy() for one in samples]), known.action)
    assert [one["task"] for one in samples] == known.sentences
    assert [episode.n_steps for episode in facts.episodes] == list(LENGTHS)
    assert facts.is_checked and facts.converted == ()
    are_images = good.name == "image"
    assert [one.endswith("stored as images, which become video (lossy)") for one in facts.kept] == (
        [True] if are_images else []
    )
