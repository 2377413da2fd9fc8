"""Things in images of demonstrations: found, given each other's colours, erased."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.models.test_episode_samples import CAMERAS, EDGE_PX, N_EPISODES, config, waits_then_moves
from vla_eval.errors import RecipeError
from vla_eval.features import ACTION_KEY
from vla_eval.models.episodes import color_objects as things
from vla_eval.models.episodes.color_objects import (
    Empty,
    SeenThings,
    Thing,
    changed_things,
    groups_of,
    things_in,
    usual_colors,
)
from vla_eval.models.episodes.samples import episodes_of

RED, MAROON, CYAN, BLUE = (230, 4, 4), (170, 4, 4), (4, 230, 230), (4, 4, 230)
EDGE = 40


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        yield


def wood(seed: int = 0) -> Tensor:
    """An image (3, 40, 40) of brown pixels, no two alike."""
    draws = np.random.default_rng(seed).integers(-12, 13, (3, EDGE, EDGE))
    return torch.from_numpy((np.array([150, 90, 60])[:, None, None] + draws).astype(np.uint8))


def with_square(image: Tensor, color: tuple[int, int, int], x: int, y: int = 20) -> Tensor:
    """A square of 6 pixels; its lower third is in the shade, half as bright."""
    image = image.clone()
    image[:, y : y + 4, x : x + 6] = torch.tensor(color, dtype=torch.uint8)[:, None, None]
    image[:, y + 4 : y + 6, x : x + 6] = torch.tensor(color, dtype=torch.uint8)[:, None, None] // 2
    return image


def color_at(image: Tensor, x: int, y: int = 20) -> tuple[int, ...]:
    return tuple(image[:, y, x].tolist())


def episode() -> tuple[Tensor, Tensor]:
    """A red cue, an empty image, then red, maroon, cyan and blue: one camera."""
    empty, last = wood(1), wood(2)
    for place, color in enumerate((MAROON, RED, CYAN, BLUE)):
        last = with_square(last, color, 2 + 10 * place)
    images = torch.stack([with_square(wood(), RED, 17), empty, last])
    return images[:, None], empty[None]


def changed(*, erases: bool, exchanges: bool) -> Tensor:
    images, empty = episode()
    return changed_things(images, empty, n_before=2, erases=erases, exchanges=exchanges)


def test_a_thing_is_a_piece_of_colours_that_empty_images_do_not_have() -> None:
    images, empty = episode()
    usual = usual_colors(empty[0].numpy())
    assert things_in(empty[0].numpy(), usual) == ()
    found = things_in(images[2, 0].numpy(), usual)
    assert [int(thing.mask.sum()) for thing in found] == [36] * 4
    colors = {tuple(thing.color.round().astype(int).tolist()) for thing in found}
    assert colors == {RED, MAROON, CYAN, BLUE}  # the side in the light, not the mean


def test_things_that_touch_are_two_if_their_hues_differ() -> None:
    _, empty = episode()
    image = with_square(with_square(wood(4), RED, 10), BLUE, 16).numpy()
    found = things_in(image, usual_colors(empty[0].numpy()))
    assert [int(thing.mask.sum()) for thing in found] == [36, 36]
    assert {tuple(thing.color.round().astype(int).tolist()) for thing in found} == {RED, BLUE}


def test_things_of_one_colour_are_a_group_and_a_darker_red_is_another() -> None:
    images, empty = episode()
    usual = usual_colors(empty[0].numpy())
    cue, *choices = [thing for frame in (0, 2) for thing in things_in(images[frame, 0].numpy(), usual)]
    groups, colors = groups_of([cue, *choices])
    assert len(choices) == 4 and len(colors) == 4
    assert groups.count(groups[0]) == 2


def test_a_thing_has_a_pixel_around_it_but_at_the_edge_of_the_image() -> None:
    _, empty = episode()
    image = with_square(with_square(wood(4), RED, 0), BLUE, 20, y=34).numpy()
    found = things_in(image, usual_colors(empty[0].numpy()))
    boxes = {tuple(thing.color.round().astype(int).tolist()): thing.box for thing in found}
    assert boxes == {RED: (slice(19, 27), slice(0, 7)), BLUE: (slice(33, 40), slice(19, 27))}
    assert all(thing.mask.shape == image[0][thing.box].shape for thing in found)


def test_things_that_were_found_before_are_found_again_and_the_oldest_are_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked = []

    def look(image: NDArray[np.uint8], usual: NDArray[np.bool_]) -> tuple[Thing, ...]:
        looked.append(image)
        return things_in(image, usual)

    monkeypatch.setattr(things, "things_in", look)
    images, empty = episode()
    cue, none, choice = images[:, 0].numpy()
    seen, before = SeenThings(2), Empty(empty[0].numpy())
    numbers = [len(seen.things_in(image, before)) for image in (cue, choice, cue.copy(), none, cue)]
    assert numbers == [1, 4, 1, 0, 1]
    assert len(looked) == 3
    seen.things_in(choice, before)  # it was used least recently when `none` came
    assert len(looked) == 4
    other = Empty(cue)
    assert len(seen.things_in(cue, other)) == 0  # with another empty image, other things
    assert len(looked) == 5


def test_colours_change_places_alike_in_all_frames_and_shades_stay() -> None:
    seen = set()
    for _ in range(30):
        images = changed(erases=False, exchanges=True)
        cue, places = (
            color_at(images[0, 0], 17),
            [color_at(images[2, 0], 2 + 10 * place) for place in range(4)],
        )
        assert sorted(places) == sorted((MAROON, RED, CYAN, BLUE))
        assert places[1] == cue  # where red was
        shade = color_at(images[2, 0], 2, y=25)
        assert shade == pytest.approx([value / 2 for value in places[0]], abs=1.5)
        assert torch.equal(images[1, 0], episode()[0][1, 0])
        seen.add(cue)
    assert seen == {MAROON, RED, CYAN, BLUE}


def test_what_is_erased_was_not_shown_and_something_else_stays() -> None:
    originals, empty = episode()
    seen = set()
    for _ in range(40):
        images = changed(erases=True, exchanges=False)
        assert torch.equal(images[:2], originals[:2])
        gone = [
            place
            for place in range(4)
            if torch.equal(
                images[2, 0][:, 20:26, 2 + 10 * place :][..., :6],
                empty[0][:, 20:26, 2 + 10 * place :][..., :6],
            )
        ]
        kept = [
            place
            for place in range(4)
            if color_at(images[2, 0], 2 + 10 * place) == (MAROON, RED, CYAN, BLUE)[place]
        ]
        assert sorted(gone + kept) == [0, 1, 2, 3]
        assert 1 in kept and len(kept) >= 2
        seen.add(tuple(gone))
    assert {len(gone) for gone in seen} == {0, 1, 2}


@pytest.mark.parametrize(("may_stay", "most"), [(0.0, 1), (0.2, 1), (0.5, 2), (1.0, 3)])
def test_so_large_a_share_of_the_three_wrong_things_may_stay(may_stay: float, most: int) -> None:
    originals, empty = episode()
    n_left = set()
    for _ in range(40):
        images = changed_things(originals, empty, n_before=2, erases=True, exchanges=False, may_stay=may_stay)
        last, whole = images[2, 0], originals[2, 0]
        n_left.add(sum(torch.equal(last[:, 20, x], whole[:, 20, x]) for x in (2, 22, 32)))
    assert n_left == set(range(1, most + 1))


def test_nothing_changes_where_no_thing_has_a_colour_that_was_shown() -> None:
    images, empty = episode()
    images[0, 0] = with_square(wood(), (4, 230, 4), 17)
    found = changed_things(images, empty, n_before=2, erases=True, exchanges=True)
    assert torch.equal(found, images)


def test_in_a_share_of_the_episodes_colours_change_places_in_all_frames_also_after_the_decision() -> None:
    """Steps 0 and 1 show the cue, 2 is empty, 3 is the decision; see `waits_then_moves`."""
    given = waits_then_moves()
    # The last episode decides at step 4 and has things in view before it: that must not hide the others'.
    given[ACTION_KEY][-1, 3:] = given[ACTION_KEY][-1, 2]
    given[ACTION_KEY][-1, 4:] += 0.5
    grey = torch.full((N_EPISODES, 6, 3, EDGE_PX, EDGE_PX), 100, dtype=torch.uint8)
    for key in CAMERAS:
        given[key] = grey.clone()
        given[key][:, :2, :, 4:8, 6:10] = torch.tensor(RED, dtype=torch.uint8)[:, None, None]
        given[key][:, 3:, :, 1:5, 1:5] = torch.tensor(RED, dtype=torch.uint8)[:, None, None]
        given[key][:, 3:, :, 9:13, 9:13] = torch.tensor(BLUE, dtype=torch.uint8)[:, None, None]
    seen = set()
    for share in (0.0, 0.5, 1.0):
        for _ in range(10):
            found = episodes_of(given, config(decision_share=0.5, exchange_share=share), training=True)
            rows = torch.arange(N_EPISODES)[:, None].expand_as(found.first)[found.first]
            for row in range(N_EPISODES - 1):
                images = found.images[rows == row]
                cue = color_at(images[0, 0], 6, 4)
                assert {color_at(image[1], 1, 1) for image in images[3:]} == {cue}
                seen.add((share, len(images), cue))
    assert seen == {
        *((0.0, n_frames, RED) for n_frames in (4, 5)),
        *((share, n_frames, color) for share in (0.5, 1.0) for n_frames in (4, 5) for color in (RED, BLUE)),
    }


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"exchange_share": 1.5, "decision_share": 0.5},
            "exchange_share is 1.5, expected a number ≤ 1",
        ),
        ({"erase_share": 0.5}, "decision_share is 0.0, expected it to be set: erase_share does nothing"),
        ({"erase_warmup_episodes": 9}, "erase_share is 0.0, expected it to be set: erase_warmup"),
        ({"erase_warmup_episodes": -1}, "erase_warmup_episodes is -1, expected a number ≥ 0"),
    ],
)
def test_a_wrong_share_is_one_message(fields: dict[str, float], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        config(**fields)


@pytest.mark.parametrize("seed", range(4))
def test_a_side_that_a_moving_arm_sees_changes_with_its_thing_and_what_is_none_stays(seed: int) -> None:
    """Sides have 0.8 or 0.65 of the colour: one of red is nearly as dark as the top of maroon."""
    images, empty = episode()
    torch.manual_seed(seed)
    sides = {2: (RED, 0.8), 10: (RED, 0.65), 18: (MAROON, 0.8), 26: (CYAN, 0.65)}
    moving = wood(5)
    for place, (color, share) in sides.items():
        red, green, blue = (round(share * level) for level in color)
        moving = with_square(moving, (red, green, blue), place)
    moving = with_square(moving, MAROON, 34)
    moving = with_square(moving, (112, 112, 120), 10, y=2)  # of the gripper
    found = changed_things(
        torch.cat([images, moving[None, None]]), empty, n_before=2, erases=False, exchanges=True
    )
    new = {
        color: np.array(color_at(found[2, 0], 2 + 10 * place))
        for place, color in enumerate((MAROON, RED, CYAN, BLUE))
    }
    assert {tuple(color) for color in new.values()} == {MAROON, RED, CYAN, BLUE}  # they have exchanged
    for place, (color, share) in sides.items():
        np.testing.assert_allclose(color_at(found[3, 0], place), share * new[color], atol=2)
    np.testing.assert_allclose(color_at(found[3, 0], 34), new[MAROON], atol=2)
    assert color_at(found[3, 0], 10, 2) == (112, 112, 120)
