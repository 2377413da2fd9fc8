"""What linear probes find in a memory: on made-up features, and on a policy of which it is known."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.probe.test_changed_memory import TASK, probe, remembers, row
from vla_eval.cli.main import main
from vla_eval.errors import RunFolderError
from vla_eval.evaluation import memory_log
from vla_eval.evaluation.memory_log import EpisodeMemory, small
from vla_eval.probe.decoding import _labels
from vla_eval.records import EpisodeRecord
from vla_eval.results.linear_probe import predicted

__all__ = ["remembers"]
pytestmark = pytest.mark.usefixtures("in_this_process")

N = 15
FAKE = ("--workers", "1", "--set", "simulator=fake", "--set", "env.horizon_steps=45", "--n-action-steps", "5")
FOLDS = np.arange(60) % 5


class TestProbe:
    def test_a_class_that_is_one_of_many_features_is_found_on_other_seeds(self) -> None:
        rng = np.random.default_rng(0)
        labels = rng.integers(0, 3, 60)
        features = rng.normal(size=(60, 40))
        features[np.arange(60), labels] += 6.0
        assert (predicted([features], labels, FOLDS) == labels).mean() >= 0.95

    def test_noise_of_many_features_is_at_chance_although_it_fits_what_it_was_fitted_on(self) -> None:
        rng = np.random.default_rng(1)
        labels = rng.integers(0, 3, 60)
        right = (predicted([rng.normal(size=(60, 500))], labels, FOLDS) == labels).sum()
        # 20 of 60 are expected; above 32 with a probability of less than 0.001.
        assert right <= 32

    def test_an_episode_is_never_predicted_by_its_own_answer(self) -> None:
        features = np.eye(60)  # a feature for each episode, which no other has
        labels = np.arange(60) % 2
        assert (predicted([features], labels, FOLDS) == labels).mean() <= 0.5

    def test_what_is_not_finite_or_constant_counts_for_nothing(self) -> None:
        labels = np.arange(60) % 3
        features = np.zeros((60, 6))
        features[np.arange(60), labels] = 1.0
        features[:, 3], features[:, 4], features[::7, 5] = np.inf, -np.inf, np.nan
        constant = np.full((60, 2), 1e30) + np.arange(60)[:, None]  # rounded away
        assert (predicted([features, constant, np.zeros((60, 3))], labels, FOLDS) == labels).all()

    def test_units_of_a_part_do_not_matter_nor_how_many_numbers_another_has(self) -> None:
        rng = np.random.default_rng(2)
        labels = rng.integers(0, 3, 60)
        one, other = rng.normal(size=(60, 8)), rng.normal(size=(60, 400))
        one[np.arange(60), labels] += 4.0
        found = predicted([one, other], labels, FOLDS)
        assert (found == labels).mean() >= 0.9
        assert (predicted([one * 1e6 + 3, other * 1e-4], labels, FOLDS) == found).all()

    def test_pixels_that_hardly_vary_do_not_drown_the_few_that_show_something(self) -> None:
        rng = np.random.default_rng(3)
        labels = rng.integers(0, 3, 60)
        image = 100 + rng.normal(scale=0.5, size=(60, 3000))
        image[np.arange(60), labels] += 60
        assert (predicted([image], labels, FOLDS) == labels).all()


def test_the_means_of_a_frame_are_over_equal_blocks() -> None:
    image = np.zeros((32, 48, 3), np.uint8)
    image[:2, :3] = 200
    image[2, 0] = 90
    means = small(image, 16)
    assert means.shape == (16, 16, 3)
    assert (means[0, 0] == 200).all()
    assert (means[1, 0] == 15).all()  # one of 2 x 3 pixels
    assert means.sum() == 3 * 215


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"memory/a": np.zeros((2, 3))}, "expected 'steps' with whole numbers"),
        ({"steps": np.zeros(2), "memory/a": np.zeros((2, 3))}, "expected 'steps' with whole numbers"),
        ({"steps": np.arange(2), "memory/a": np.zeros((3, 3))}, "expected an array with 2 rows"),
        ({"steps": np.arange(2), "other": np.zeros((2, 3))}, "expected an array with 2 rows"),
        ({"steps": np.arange(2), "memory/a": np.array(["a", "b"])}, "expected numbers, found <U1"),
        ({"steps": np.arange(2), "memory/a": np.array([None, {}])}, "Object arrays cannot be loaded"),
    ],
)
def test_a_file_that_is_another_one_is_refused_and_no_pickle_is_loaded(
    arrays: dict[str, Any], says: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **arrays)
    with pytest.raises(RunFolderError, match=says):
        EpisodeMemory.read(path)


def test_a_small_file_that_unpacks_to_very_much_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert memory_log.MAX_BYTES == 2**30
    monkeypatch.setattr(memory_log, "MAX_BYTES", 2**24)
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("steps.npy", "w") as file:
        for _ in range(17):
            file.write(bytes(2**20))
    with pytest.raises(RunFolderError, match="expected at most 16777216 bytes when unpacked"):
        EpisodeMemory.read(path)


@pytest.mark.parametrize("data", [b"", b"PK", b"\x80\x04K\x01.", b"no archive at all"])
def test_bytes_that_are_no_archive_are_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(data)
    with pytest.raises(RunFolderError, match="expected arrays in npz"):
        EpisodeMemory.read(path)


def test_what_a_policy_keeps_is_decoded_from_the_step_on_that_it_is_shown(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ("--policy", str(remembers / "remembers.yaml"), "--no-controls", "--decode")
    found = probe(remembers, capsys, *policy, "--probe", "reset", "--reset-at", "5", "--episodes", str(N))
    own = {one["label"]: one for one in found["decoded"]}
    assert set(own) == {"item", "place", "time"}
    item = own["item"]
    assert item["response_step"] == 10
    assert [point["step"] for point in item["points"]] == list(range(0, 45, 5))
    # After the inference at step 0 the shown one is stored, and stays.
    assert {(point["n_episodes"], point["decoded"]) for point in item["points"]} == {(N, 1.0)}
    assert {point["decoded_from_frame"] for point in item["points"]} == {None}  # it reads no camera
    assert item["acts"] == {"both": N, "knows": 0, "acts": 0, "neither": 0}
    # Its place is drawn apart from its colour: the memory does not hold it.
    assert own["place"]["points"][2]["decoded"] < 0.8
    assert own["time"]["points"][0]["decoded"] == 1.0  # it counts its inferences
    assert row(found, "none")["n_follows"] == N
    assert len(list((remembers / "out" / f"{TASK}_none" / "memories").glob("*.npz"))) == N
    assert (remembers / f"out_{TASK}_item_decoded.png").is_file()

    runs = [str(path) for path in sorted((remembers / "out").iterdir())]
    sentence = (
        f"at the response a linear probe reads the item from its memory in {N} of {N} episodes. Of these it "
        f"follows the cue in {N}, of the other 0 in 0."
    )
    assert main(["report", *runs]) == 0
    assert sentence in capsys.readouterr().out
    assert main(["report", *runs, "--html", str(remembers / "page")]) == 0
    page = (remembers / "page" / "index.html").read_text()
    assert "In the memory" in page and sentence in page


def test_without_it_no_memory_is_kept(remembers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = ("--policy", str(remembers / "remembers.yaml"), "--no-controls", "--probe", "blank")
    assert probe(remembers, capsys, *policy)["decoded"] == []
    assert not (remembers / "out" / f"{TASK}_none" / "memories").exists()
    main(
        [
            "probe",
            "--task",
            TASK,
            *policy,
            "--episodes",
            "6",
            "--out",
            str(remembers / "out"),
            *FAKE,
            "--decode",
        ]
    )
    assert "6 of 6 episodes were run without --decode" in capsys.readouterr().err


def test_too_few_episodes_say_nothing(remembers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = ("--policy", str(remembers / "remembers.yaml"), "--no-controls", "--decode")
    found = probe(remembers, capsys, *policy)
    assert found["decoded"] == []
    assert [one["intervention"] for one in found["rows"]] == ["none"]  # without --probe, nothing else is run
    assert json.loads((remembers / "out" / f"{TASK}_none" / "run.json").read_text())["memories"]


def test_a_label_with_one_answer_or_with_those_of_another_is_not_asked() -> None:
    def record(seed: int, **fields: Any) -> EpisodeRecord:
        return EpisodeRecord(
            task=TASK, policy="p", n_action_steps=1, run=0, seed=seed, outcome="success", **fields
        )

    def names(*fields: dict[str, Any]) -> list[str]:
        return [label.name for label in _labels([record(seed, **one) for seed, one in enumerate(fields)])]

    apart = [{"target": i % 2, "target_place": i // 2, "right_candidates": (i % 2,)} for i in range(4)]
    assert names(*apart) == ["item", "place"]
    same = [{"target": i, "target_place": i, "right_candidates": (i,)} for i in range(3)]
    assert names(*same) == ["item"]  # as in the shell game
    several = [{"right_candidates": order} for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0))]
    assert names(*several) == ["item 1", "item 2", "item 3"]
    assert names({"target": 1}, {"target": 1}) == []
