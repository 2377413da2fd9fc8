"""Training samples with memory: what a rollout shows at the same frame."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from vla_eval.core import EpisodeStart
from vla_eval.data.frames.remembered_frames import RememberedFramesDataset
from vla_eval.models.episodes.running import Episode
from vla_eval.models.shared.earlier_frames import (
    SEGMENT_PADDING_KEY,
    FrameMemory,
    SampleMemory,
    Segments,
    mask_field,
    place_field,
    place_fields,
)
from vla_eval.models.shared.frame_choice import FrameChoice
from vla_eval.testing.synthetic import write_synthetic_dataset

BASE, WRIST = "observation.images.base", "observation.images.wrist"
CHOICES = {
    "last": FrameChoice(rule="last", n_places=2, stride=3, least_novelty=0.5),
    "keyframes": FrameChoice(rule="keyframes", n_places=2, stride=1, least_novelty=0.002),
}
N_EPISODES, N_FRAMES = 2, 13  # lengths 13 and 14


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("remembered") / "tiny"
    return write_synthetic_dataset(folder, n_episodes=N_EPISODES, n_frames=N_FRAMES)


@pytest.fixture(scope="module")
def plain(root: Path) -> LeRobotDataset:
    return LeRobotDataset("local/tiny", root=root)


def dataset(root: Path, cache: Path, memory: SampleMemory, **options: Any) -> RememberedFramesDataset:
    return RememberedFramesDataset(LeRobotDataset("local/tiny", root=root, **options), memory, cache=cache)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("rule", CHOICES)
@pytest.mark.parametrize("cameras", [(BASE,), (WRIST, BASE)])
def test_every_sample_shows_the_frames_that_a_rollout_shows_for_any_number_of_action_steps(
    rule: str, cameras: tuple[str, ...], root: Path, plain: LeRobotDataset, tmp_path: Path
) -> None:
    choice = CHOICES[rule]
    samples = dataset(root, tmp_path, SampleMemory(choice=choice, cameras=cameras, segments=None))
    shown = set()
    for first, stop in ((0, N_FRAMES), (N_FRAMES, 2 * N_FRAMES + 1)):
        frames = [{camera: plain[row][camera] for camera in (BASE, WRIST)} for row in range(first, stop)]
        for n_action_steps in (1, 4):
            episode = begun(FrameMemory(choice=choice, cameras=cameras))
            for newest in range(0, stop - first, n_action_steps):
                new = frames[max(0, newest - n_action_steps + 1) : newest + 1]
                episode = episode.shown(new, step=newest, n_kept=1)
                ours = samples[first + newest]
                theirs = episode.read((), masks_history=False)
                assert {key for key in ours if key.startswith("observation.images")} == set(theirs)
                assert all(torch.equal(ours[key], value) for key, value in theirs.items())
                shown.add(tuple(bool(theirs[mask_field(place_field(BASE, place))]) for place in (1, 2)))
    assert shown == {(False, False), (True, False), (True, True)}


def begun(memory: FrameMemory) -> Episode:
    start = EpisodeStart(slot=0, task="t", seed=1, run=0, instruction="i", horizon_steps=20)
    return Episode(start=start, earlier=memory)


def test_fields_come_in_the_policys_order_and_keep_their_type(root: Path, tmp_path: Path) -> None:
    memory = SampleMemory(choice=CHOICES["last"], cameras=(BASE,), segments=None)
    samples = dataset(root, tmp_path, memory, return_uint8=True)
    names = place_fields((BASE,), 2)
    assert samples.image_fields == (BASE, WRIST, *names)
    sample = samples[8]
    assert all(sample[name].dtype == torch.uint8 and sample[name].shape == (3, 128, 128) for name in names)
    assert torch.equal(sample[names[0]], samples[5][BASE])
    assert torch.equal(sample[names[1]], samples[2][BASE])
    assert samples[0][names[0]].abs().max() == 0 and not samples[0][mask_field(names[0])]


def test_an_augmentation_changes_the_frames_of_a_sample_alike(root: Path, tmp_path: Path) -> None:
    drawn: list[float] = []

    def darker(images: Tensor) -> Tensor:
        drawn.append(0.5 if len(drawn) % 2 else 0.25)
        return images * drawn[-1]

    memory = SampleMemory(choice=CHOICES["last"], cameras=(BASE,), segments=None)
    plain_samples = dataset(root, tmp_path, memory)
    changed = dataset(root, tmp_path, memory, image_transforms=darker)[8]
    assert len(drawn) == 2  # once for each camera
    for key in (BASE, *place_fields((BASE,), 2)):
        torch.testing.assert_close(changed[key], plain_samples[8][key] * drawn[0])


def test_a_sample_in_segments_is_the_frames_at_which_memory_is_written_and_its_own(
    root: Path, tmp_path: Path
) -> None:
    deltas = {"action": [0.0, 0.05]}
    segments = Segments(stride=4, n_segments=5)
    memory = SampleMemory(choice=CHOICES["last"], cameras=(BASE,), segments=segments)
    ours = dataset(root, tmp_path, memory, delta_timestamps=deltas)
    alone = dataset(
        root,
        tmp_path,
        SampleMemory(choice=memory.choice, cameras=(BASE,), segments=None),
        delta_timestamps=deltas,
    )
    sample = ours[N_FRAMES + 10]  # frame 10 of the second episode
    rows = [N_FRAMES + number for number in (0, 0, 4, 8, 10)]
    assert sample[SEGMENT_PADDING_KEY].tolist() == [True, False, False, False, False]
    assert sample["task"] == alone[rows[0]]["task"]
    for place, row in enumerate(rows):
        for key, value in alone[row].items():
            if key != "task":
                assert torch.equal(sample[key][place], value), key
    assert ours[4]["frame_index"].tolist() == [0, 0, 0, 0, 4]
    assert ours[0][SEGMENT_PADDING_KEY].tolist() == [True, True, True, True, False]
