"""The switches that reproduce the paper's public evaluation, and that nothing happens without them."""

from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.models.openvla import openvla_golden as golden
from vla_eval.core import ActionChunk, Observation, ObservationWindow
from vla_eval.errors import UnknownNameError
from vla_eval.policies.lerobot.paper_compat import PaperCompatPolicy, jpeg_round_trip, make_paper_compat
from vla_eval.specs import PolicySpec


class Counting:
    """Gives chunks of 8 actions: the row's number, and gripper values from -1 to 1; keeps what it saw."""

    spec = PolicySpec(name="counting", reads="last", cameras=("base",), states=(), chunk_size=8)

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def act_batch(self, windows: Any) -> list[ActionChunk]:
        self.seen = [window.last.images["base"] for window in windows]
        actions = np.tile(np.arange(8, dtype=np.float32)[:, None], (1, 7))
        actions[:, -1] = [-1, -0.5, 0, 0.25, 0.5, 0.75, 1, 1]
        return [ActionChunk(actions=actions) for _ in windows]


def window() -> ObservationWindow:
    image = golden.values()["data.image"].numpy()
    return ObservationWindow(slot=0, frames=(Observation(step=0, images={"base": image}, state={}),))


def chunk(*switches: str, n_action_steps: int = 4) -> Any:
    policy: Any = Counting()
    return PaperCompatPolicy(policy, switches, n_action_steps=n_action_steps).act(window()).actions


def test_without_switches_the_first_actions_come_first_and_nothing_is_changed() -> None:
    actions = chunk()
    assert actions[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert actions[:, -1].tolist() == [-1, -0.5, 0, 0.25, 0.5, 0.75, 1, 1]


@pytest.mark.parametrize(("n_action_steps", "expected"), [(4, [4, 5, 6, 7]), (8, list(range(8)))])
def test_the_queue_keeps_the_last_actions(n_action_steps: int, expected: list[int]) -> None:
    assert chunk("last_k_queue", n_action_steps=n_action_steps)[:, 0].tolist() == expected


def test_the_gripper_is_inverted_about_one_half() -> None:
    # -sign(2 g - 1) of -1, -0.5, 0, 0.25, 0.5, 0.75, 1, 1
    assert chunk("gripper_sign")[:, -1].tolist() == [1, 1, 1, 1, 0, -1, -1, -1]


def test_images_go_through_jpeg_of_quality_95() -> None:
    policy: Any = Counting()
    PaperCompatPolicy(policy, ["jpeg"], n_action_steps=4).act(window())
    theirs = golden.values()["data.jpeg_decoded"].float()
    difference = (torch.from_numpy(policy.seen[0]).float() - theirs).abs()
    # TensorFlow's encoder is another one: at most 19 levels apart on this image, by the golden README.
    assert float(difference.max()) <= 19
    raw = golden.values()["data.image"].float()
    assert float(difference.mean()) < 0.5 * float((raw - theirs).abs().mean())


def test_a_plain_image_survives_jpeg() -> None:
    image = np.full((16, 16, 3), 200, np.uint8)
    assert np.abs(jpeg_round_trip(image).astype(int) - 200).max() <= 1
    assert Image.fromarray(image).size == (16, 16)


def test_a_mistyped_switch_is_named() -> None:
    context: Any = None
    with pytest.raises(UnknownNameError, match="Did you mean 'gripper_sign'"):
        make_paper_compat(context, paper_compat=["gripper_sing"])
