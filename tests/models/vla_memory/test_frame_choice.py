"""Which earlier frames a rule shows, on images made for it."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from vla_eval.core import ImageArray
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.models.shared.frame_choice import BLOCKS, FrameChoice, Seen, blocks_of, novelty

N_PX = 64


def choice(rule: str = "keyframes", **changes: Any) -> FrameChoice:
    fields: dict[str, Any] = {"n_places": 2, "stride": 3, "least_novelty": 0.08}
    return FrameChoice(rule=rule, **{**fields, **changes})


def shown_after(rule: FrameChoice, images: Sequence[ImageArray]) -> list[tuple[int | None, ...]]:
    """Return what is shown at each frame."""
    seen, shown = Seen(), []
    for image in images:
        seen = rule.after(seen, image)
        shown.append(rule.shown(seen))
    return shown


def scene(*, cue: int = 0, arm_px: int = 0) -> ImageArray:
    """Return a grey table; with a cue of 6 × 6 px of this brightness, and an arm that has come so far."""
    image = np.full((3, N_PX, N_PX), 100, dtype=np.uint8)
    if cue:
        image[:, 10:16, 20:26] = cue
    image[:, 40:, :arm_px] = 160
    return image


class TestLast:
    def test_every_stride_th_frame_is_shown_the_nearest_first(self) -> None:
        shown = shown_after(choice("last"), [scene()] * 8)
        assert shown[7] == (4, 1)

    def test_before_there_are_enough_frames_places_are_empty(self) -> None:
        shown = shown_after(choice("last"), [scene()] * 7)
        assert shown[:7] == [(None, None)] * 3 + [(0, None), (1, None), (2, None), (3, 0)]


class TestKeyframes:
    def test_the_last_frame_with_a_cue_is_shown_from_the_frame_on_that_lacks_it(self) -> None:
        shown = shown_after(choice(), [scene(cue=250)] * 5 + [scene()] * 20)
        assert shown[4] == (None, None)
        assert shown[5:] == [(4, None)] * 20

    def test_a_scene_that_does_not_change_has_no_keyframe(self) -> None:
        noise = np.random.default_rng(0)
        images = [scene() + noise.integers(0, 4, (3, N_PX, N_PX), dtype=np.uint8) for _ in range(20)]
        assert set(shown_after(choice(), images)) == {(None, None)}

    def test_an_arm_that_moves_for_long_does_not_push_the_cue_out(self) -> None:
        arm = [scene(arm_px=min(N_PX, step)) for step in range(60)]
        shown = shown_after(choice(), [scene(cue=250)] * 5 + [scene()] * 5 + arm)
        assert all(4 in places for places in shown[5:])

    def test_cues_one_after_the_other_are_each_shown_oldest_first(self) -> None:
        images = [scene(cue=cue) for cue in (250, 20, 180) for _ in range(6)] + [scene()] * 6
        assert shown_after(choice(n_places=3), images)[-1] == (5, 11, 17)

    def test_of_too_many_changes_the_least_is_forgotten(self) -> None:
        images = [scene(cue=cue) for cue in (250, 190, 20) for _ in range(6)] + [scene()] * 6
        # Changes of 60, 170 and 80 levels in a block that the cue covers in part: 5, 11 and 17 come before.
        assert shown_after(choice(n_places=2), images)[-1] == (11, 17)

    def test_a_change_over_several_frames_is_one_event(self) -> None:
        fading = [scene(cue=cue) for cue in (250, 210, 170, 130)]
        assert shown_after(choice(), [scene(cue=250)] * 5 + fading[1:] + [scene()] * 9)[-1] == (4, None)

    def test_images_that_are_needed_and_missing_are_an_error(self) -> None:
        with pytest.raises(ValueError, match="chooses from images, found none"):
            choice().after(Seen(), None)


@pytest.mark.parametrize("rule", [choice("last"), choice(), choice("last", n_places=5, stride=1)])
class TestEveryRule:
    def test_what_is_kept_is_enough_for_all_that_is_shown_later(self, rule: FrameChoice) -> None:
        draws = np.random.default_rng(1)
        images = [draws.integers(0, 256, (3, N_PX, N_PX), dtype=np.uint8) for _ in range(60)]
        seen, kept = Seen(), set[int]()
        for number, image in enumerate(images):
            seen = rule.after(seen, image)
            kept = {*kept, number} & rule.wanted(seen)  # as a rollout forgets
            assert {place for place in rule.shown(seen) if place is not None} <= kept

    def test_what_is_kept_does_not_grow_with_the_episode(self, rule: FrameChoice) -> None:
        draws = np.random.default_rng(1)
        seen, sizes = Seen(), []
        for _ in range(80):
            seen = rule.after(seen, draws.integers(0, 256, (3, N_PX, N_PX), dtype=np.uint8))
            sizes.append((len(rule.wanted(seen)), len(seen.events)))
        most = max(rule.n_places * rule.stride, rule.n_places) + 1
        assert max(n_frames for n_frames, _ in sizes) <= most
        assert max(n_events for _, n_events in sizes) <= rule.n_places

    def test_only_earlier_frames_are_shown_each_once(self, rule: FrameChoice) -> None:
        draws = np.random.default_rng(2)
        images = [draws.integers(0, 256, (3, N_PX, N_PX), dtype=np.uint8) for _ in range(40)]
        for number, places in enumerate(shown_after(rule, images)):
            there = [place for place in places if place is not None]
            assert len(set(there)) == len(there) and all(0 <= place < number for place in there)


def test_blocks_are_means_whatever_the_size_and_the_order_in_memory() -> None:
    image = np.random.default_rng(0).integers(0, 256, (3, 50, 70), dtype=np.uint8)
    n_blocks = BLOCKS[1]
    edges = [[index * size // n_blocks for index in range(n_blocks + 1)] for size in (50, 70)]
    row, column = 3, 11
    block = image[1, edges[0][row] : edges[0][row + 1], edges[1][column] : edges[1][column + 1]]
    assert blocks_of(image)[1][1, row, column] == pytest.approx(block.mean() / 255)
    other_order = np.asfortranarray(image)
    for one, other in zip(blocks_of(image), blocks_of(other_order), strict=True):
        assert np.array_equal(one, other)


def test_novelty_is_that_of_the_place_that_changed_most() -> None:
    before, after = scene(), scene()
    after[:, 8:12, 4:8] = 151  # one block of 4 × 4 px, by 51 levels
    after[:, 48:52, 48:52] = 120
    assert novelty(blocks_of(before), blocks_of(after)) == pytest.approx(51 / 255)


def test_what_changes_around_a_place_is_subtracted_from_its_novelty() -> None:
    before, after = scene(), scene()
    after[:, :, 20:40] = 151  # as if an arm stood there at once
    assert novelty(blocks_of(before), blocks_of(after)) < 0.02
    brighter = (scene() + 51).astype(np.uint8)  # a lamp
    assert novelty(blocks_of(before), blocks_of(brighter)) <= 0


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        (lambda: choice("first"), UnknownNameError),
        (lambda: choice(n_places=0), RecipeError),
        (lambda: choice(stride=0), RecipeError),
        (lambda: choice(least_novelty=0.0), RecipeError),
    ],
)
def test_a_rule_with_wrong_numbers_is_refused(wrong: Callable[[], Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        wrong()
