"""What is done to the images of episodes that are trained on."""

from collections.abc import Iterator

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor

from vla_eval.control_modes import CONTROL_MODES
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.features import ACTION_KEY, ACTION_PADDING_KEY, STATE_KEY
from vla_eval.models.episodes.samples import AT_REST_M, Episodes, after_waiting, count_motions, episodes_of
from vla_eval.models.sequence.configuration_sequence import MikasaSequenceConfig
from vla_eval.models.shared.images import in_numbers

CAMERAS = ("observation.images.base", "observation.images.wrist")
N_EPISODES, N_STEPS, CHUNK, EDGE_PX, MOST_PX = 6, 5, 8, 16, 3


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(7)
        yield


def config(
    *, window_steps: int = N_STEPS, waiting_share: float = 1.0, **fields: object
) -> MikasaSequenceConfig:
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, EDGE_PX, EDGE_PX))
    return MikasaSequenceConfig(
        device="cpu",
        window_steps=window_steps,
        waiting_share=waiting_share,
        input_features={
            **dict.fromkeys(CAMERAS, image),
            STATE_KEY: PolicyFeature(type=FeatureType.STATE, shape=(10,)),
        },
        output_features={ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(7,))},
        **fields,  # type: ignore[arg-type]  # fields of a dataclass
    )


def batch() -> dict[str, Tensor]:
    """Return episodes whose every pixel has a value of its own in each frame."""
    n_pixels = N_EPISODES * (N_STEPS + 1) * 3 * EDGE_PX**2
    images = (torch.randperm(n_pixels) / n_pixels).reshape(N_EPISODES, N_STEPS + 1, 3, EDGE_PX, EDGE_PX)
    n_actions = N_STEPS - 1 + CHUNK
    return {
        CAMERAS[0]: images,
        CAMERAS[1]: 1 - images,
        STATE_KEY: torch.zeros(N_EPISODES, N_STEPS + 1, 10),
        f"{STATE_KEY}_is_pad": torch.zeros(N_EPISODES, N_STEPS + 1, dtype=torch.bool),
        ACTION_KEY: torch.rand(N_EPISODES, n_actions, 7),
        ACTION_PADDING_KEY: torch.zeros(N_EPISODES, n_actions, dtype=torch.bool),
    }


def waits_then_moves() -> dict[str, Tensor]:
    """The arm moves at step 0, waits at 1 and 2, moves at 3 and 4: the decision is step 3."""
    given = batch()
    given[ACTION_KEY] = torch.zeros(N_EPISODES, N_STEPS - 1 + CHUNK, 7)
    given[ACTION_KEY][:, 3:] = torch.arange(1.0, N_STEPS - 1 + CHUNK - 2)[:, None] / CHUNK
    return given


def shown_images(episodes: Episodes) -> Tensor:
    """Return (B, T, cameras, 3, H, W), what each step shows."""
    return episodes.images[episodes.frames]


def found_shift(seen: Tensor, moved: Tensor) -> tuple[int, int]:
    """Return the one shift (down, right) that makes `moved` (3, H, W) of `seen`, pixel by pixel."""
    fits = []
    for down in range(-EDGE_PX, EDGE_PX + 1):
        for right in range(-EDGE_PX, EDGE_PX + 1):
            from_y = [min(max(y - down, 0), EDGE_PX - 1) for y in range(EDGE_PX)]
            from_x = [min(max(x - right, 0), EDGE_PX - 1) for x in range(EDGE_PX)]
            if torch.equal(seen[:, from_y][:, :, from_x], moved):
                fits.append((down, right))
    assert len(fits) == 1
    return fits[0]


def test_the_images_of_an_episode_are_moved_together_and_those_of_each_camera_by_their_own_amount() -> None:
    given = batch()
    images = shown_images(episodes_of(given, config(shift_px=MOST_PX), training=True))

    shifts = [
        [
            found_shift(given[key][episode, 0], images[episode, 0, camera])
            for camera, key in enumerate(CAMERAS)
        ]
        for episode in range(N_EPISODES)
    ]
    for episode in range(N_EPISODES):
        for camera, key in enumerate(CAMERAS):
            last = given[key][episode, N_STEPS - 1]
            assert found_shift(last, images[episode, N_STEPS - 1, camera]) == shifts[episode][camera]
    amounts = {shift for of_episode in shifts for shift in of_episode}
    assert len(amounts) > N_EPISODES
    assert max(abs(px) for shift in amounts for px in shift) <= MOST_PX
    assert any(base != wrist for base, wrist in shifts)


def test_images_are_not_moved_at_zero_pixels_nor_outside_training() -> None:
    given = batch()
    shown = torch.stack([given[key][:, :N_STEPS] for key in CAMERAS], dim=2)
    assert torch.equal(shown_images(episodes_of(given, config(), training=True)), shown)
    assert torch.equal(shown_images(episodes_of(given, config(shift_px=MOST_PX), training=False)), shown)


def test_a_negative_shift_is_refused() -> None:
    with pytest.raises(RecipeError, match="shift_px is -1, expected a number ≥ 0"):
        config(shift_px=-1)


def test_images_in_bytes_are_those_numbers() -> None:
    as_bytes = batch()
    for key in CAMERAS:
        as_bytes[key] = (as_bytes[key] * 255).to(torch.uint8)
    as_numbers = as_bytes | {key: as_bytes[key].to(torch.float32) / 255 for key in CAMERAS}
    of_bytes, of_numbers = (
        episodes_of(given, config(), training=False).images for given in (as_bytes, as_numbers)
    )
    assert of_bytes.dtype == torch.uint8
    assert torch.equal(in_numbers(of_bytes), of_numbers)
    assert torch.equal(in_numbers(of_numbers), of_numbers)


def test_actions_beyond_the_next_decision_do_not_count_where_that_is_asked_for() -> None:
    given = waits_then_moves()
    all_of_it = episodes_of(given, config(), training=False)
    assert (all_of_it.counts > 0).all()
    assert (all_of_it.goal_counts > 0).all()
    episodes = episodes_of(given, config(masks_beyond_decision=True), training=False)
    assert (episodes.goal_counts[0] > 0).tolist() == [False, False, False, True, True]
    masked = episodes.counts[0] > 0
    n_counted = [int(of_step.sum()) for of_step in masked]
    assert n_counted == [3, 2, 1, CHUNK, CHUNK]
    assert all(bool(masked[step, :n].all()) for step, n in enumerate(n_counted))


def test_without_any_decision_the_goal_counts_at_every_step() -> None:
    given = batch()
    given[ACTION_KEY] = torch.arange(0.0, N_STEPS - 1 + CHUNK)[:, None].expand(N_EPISODES, -1, 7) / CHUNK
    episodes = episodes_of(given, config(masks_beyond_decision=True), training=False)
    assert (episodes.goal_counts > 0).all()
    assert (episodes.counts > 0).all()


def test_actions_beyond_the_next_decision_are_those_of_waiting_where_that_is_asked_for() -> None:
    given = waits_then_moves()
    given[ACTION_KEY][:, 1:3] = 0.5
    given[ACTION_KEY][:, 0] = 0.25
    fields = {"masks_beyond_decision": True, "waits_beyond_decision": True}
    episodes = episodes_of(given, config(**fields), training=False)
    assert (episodes.counts > 0).all()
    first = [of_step[:, 0].tolist() for of_step in episodes.actions[0]]
    assert first[0] == [0.25, *[0.5] * (CHUNK - 1)]
    assert first[1] == first[2] == [0.5] * CHUNK
    assert first[3] == given[ACTION_KEY][0, 3 : 3 + CHUNK, 0].tolist()
    assert (episodes.goal_counts[0] > 0).tolist() == [False, False, False, True, True]
    with pytest.raises(RecipeError, match="masks_beyond_decision is False, expected it to be set"):
        config(waits_beyond_decision=True)


def test_the_frame_of_a_decision_is_shown_up_to_so_many_times_again() -> None:
    given, n_late = waits_then_moves(), set()
    for _ in range(8):
        episodes = episodes_of(given, config(late_steps=3), training=True)
        assert len(episodes.images) == N_EPISODES * N_STEPS  # each frame is encoded once
        images_of_all = shown_images(episodes)
        for steps, counts, images in zip(episodes.steps, episodes.counts, images_of_all, strict=True):
            shown = steps[counts[:, 0] > 0].tolist()
            assert shown == sorted(shown) and set(shown) == set(range(N_STEPS))
            n_late.add(shown.count(3) - 1)
            assert len(shown) == N_STEPS + shown.count(3) - 1
            assert torch.equal(images[shown.index(3)], images[shown.index(4) - 1])
    assert n_late == {0, 1, 2, 3}
    once = episodes_of(given, config(late_steps=3), training=False).steps
    assert once.tolist() == [list(range(N_STEPS))] * N_EPISODES


def test_a_decision_counts_as_much_however_often_it_is_shown() -> None:
    given = waits_then_moves()
    once = episodes_of(given, config(), training=False).counts
    for _ in range(4):
        episodes = episodes_of(given, config(late_steps=3), training=True)
        for steps, counts, expected in zip(episodes.steps, episodes.counts, once, strict=True):
            is_there = counts[:, 0] > 0
            for step in range(N_STEPS):
                assert torch.allclose(counts[is_there & (steps == step)].sum(dim=0), expected[step])


def test_a_late_decision_may_be_where_an_episode_ends() -> None:
    episodes = episodes_of(waits_then_moves(), config(late_steps=3, decision_share=1.0), training=True)
    for steps, counts in zip(episodes.steps, episodes.counts, strict=True):
        shown = steps[counts[:, 0] > 0].tolist()
        assert shown[:3] == [0, 1, 2] and set(shown[3:]) == {3} and len(shown) <= 7


class TestMotions:
    @pytest.mark.parametrize(
        ("sizes", "n_motions"),
        [
            ([0, 0, 1, 0.6, 0.3, 0.1], 1),  # waits, sets out, slows down
            ([1, 0.6, 0.3, 0.1, 0.05, 0], 1),  # sets out at once
            ([0, 1, 0.2, 0.1, 1.2, 0.4], 2),  # slows down, and sets out again
            ([0, 1, 0.2, 0, 0, 1], 2),  # waits in between
            ([0, 0.4, 0.8, 0.4, 0.2, 0], 0),  # no jerk
        ],
    )
    def test_a_motion_begins_where_the_arm_sets_out(self, sizes: list[float], n_motions: int) -> None:
        actions = torch.zeros(1, len(sizes), 7)
        actions[0, :, 1] = -torch.tensor(sizes)  # any direction
        actions[0, :, 6] = torch.tensor(sizes).roll(1)  # the gripper is no motion of the arm
        assert count_motions(actions, torch.ones(1, len(sizes), dtype=torch.bool)).tolist() == [n_motions]

    def test_padding_before_an_episode_does_not_move(self) -> None:
        actions = torch.ones(1, 6, 7)
        real = torch.tensor([[False, False, True, True, True, True]])
        assert count_motions(actions, real).tolist() == [1]


class TestGoals:
    """The goal of a step is where the demonstration ends, or where its motion does."""

    SIZES = (0, 0, 1, 0.6, 1.2, 0.4, 0.2, 1)  # waits; sets out at 2, 4 and 7

    def given(self, sizes: tuple[float, ...], *, n_real: int) -> dict[str, Tensor]:
        n_steps, n_actions = len(sizes), len(sizes) - 1 + CHUNK
        actions = torch.zeros(2, n_actions, 7)
        actions[:, :n_steps, 0] = torch.tensor(sizes)
        state = torch.zeros(2, n_steps + 1, 10)
        state[:, :, 0] = torch.arange(n_steps + 1)  # the tool is at x = t at step t
        state[:, n_real:, 0] = n_real - 1  # beyond the episode LeRobot repeats its last frame
        images = torch.rand(2, n_steps + 1, 3, EDGE_PX, EDGE_PX)
        is_pad = torch.zeros(2, n_steps + 1, dtype=torch.bool)
        is_pad[:, n_real:] = True
        return {
            **dict.fromkeys(CAMERAS, images),
            STATE_KEY: state,
            f"{STATE_KEY}_is_pad": is_pad,
            ACTION_KEY: actions,
            ACTION_PADDING_KEY: torch.zeros(2, n_actions, dtype=torch.bool),
        }

    def goals(self, sizes: tuple[float, ...], *, each_motion: bool, n_real: int | None = None) -> list[float]:
        n_real = n_real or len(sizes)
        given = self.given(sizes, n_real=n_real)
        made = config(window_steps=len(sizes), masks_beyond_decision=True)
        episodes = episodes_of(given, made, training=False, each_motion=each_motion)
        goals: list[float] = episodes.goal_m[0, :n_real, 0].tolist()
        return goals

    def test_a_demonstration_has_one(self) -> None:
        assert self.goals(self.SIZES, each_motion=False) == [7] * 8

    def test_each_motion_has_one_and_the_first_is_that_of_waiting(self) -> None:
        assert self.goals(self.SIZES, each_motion=True) == [4, 4, 4, 4, 7, 7, 7, 7]

    def test_an_arm_that_moves_once_has_that_of_the_demonstration(self) -> None:
        sizes = (0, 0, 1, 0.6, 0.3, 0.1)
        assert self.goals(sizes, each_motion=True) == self.goals(sizes, each_motion=False) == [5] * 6

    def test_an_arm_that_never_moves_has_that_of_the_demonstration(self) -> None:
        assert self.goals((0, 0, 0, 0), each_motion=True) == [3] * 4

    def test_what_comes_after_a_shorter_episode_is_no_motion(self) -> None:
        assert self.goals((0, 1, 0.3, 1, 0.2, 0, 1), each_motion=True, n_real=5) == [3, 3, 3, 4, 4]

    def test_a_motion_begins_with_a_decision_that_an_earlier_chunk_cannot_know(self) -> None:
        given = self.given(self.SIZES, n_real=8)
        made = config(window_steps=8, masks_beyond_decision=True, change_weight=0.0)

        counted = {
            each: (episodes_of(given, made, training=False, each_motion=each).counts[0] > 0).sum(dim=-1)
            for each in (False, True)
        }

        assert counted[False].tolist() == [2, 1, *[CHUNK] * 6]  # what follows the one decision, at 2
        assert counted[True].tolist() == [2, 1, 2, 1, 3, 2, 1, CHUNK]  # up to 2, 4 and 7

    def test_samples_end_at_each_of_them(self) -> None:
        given, ends = self.given(self.SIZES, n_real=8), set()
        made = config(window_steps=8, decision_share=1.0)
        for _ in range(20):
            episodes = episodes_of(given, made, training=True, each_motion=True)
            ends |= {
                int(steps[counts[:, 0] > 0].max())
                for steps, counts in zip(episodes.steps, episodes.counts, strict=True)
            }
        assert ends == {2, 4, 7}

    def test_steps_of_motion_can_be_left_out_and_decisions_stay(self) -> None:
        """Of moving first, too: the first step of an episode is no motion."""
        sizes = (1, 0.6, 0, 0, 1, 0.6, 1.2, 0.4)  # moves, waits, sets out at 4 and 6
        given = self.given(sizes, n_real=8)
        kept = {
            share: {
                tuple(dict.fromkeys(steps[counts[:, 0] > 0].tolist()))
                for _ in range(20)
                for episodes in [
                    episodes_of(
                        given, config(window_steps=8, moving_share=share), training=True, each_motion=True
                    )
                ]
                for steps, counts in zip(episodes.steps, episodes.counts, strict=True)
            }
            for share in (1e-9, 0.5, 1.0)
        }
        assert kept[1.0] == {tuple(range(8))}
        assert kept[1e-9] == {(0, 3, 4, 6, 7)}  # 3 waits; the last one is the frame that was sampled
        assert len(kept[0.5]) > 2 and all({0, 3, 4, 6, 7} <= {*steps} for steps in kept[0.5])

    @pytest.mark.parametrize(("share", "run_steps"), [(0.2, 5), (0.25, 4), (1 / 3, 3), (1.0, 1)])
    def test_waiting_that_is_used_evenly_misses_no_cue_as_long_as_its_distance(
        self, share: float, run_steps: int
    ) -> None:
        sizes = (1, *(0,) * 13, 0.6, 1.2, *(0,) * 13)
        given = self.given(sizes, n_real=len(sizes))
        made = config(window_steps=len(sizes), waiting_share=share, waits_evenly=True)
        # An action that differs from the one before is no waiting; nor is the frame that was sampled.
        waits = [*range(2, 14), *range(17, len(sizes) - 1)]
        found = set()
        for _ in range(20):
            episodes = episodes_of(given, made, training=True, each_motion=True)
            for steps, counts in zip(episodes.steps, episodes.counts, strict=True):
                used = {*steps[counts[:, 0] > 0].tolist()}
                runs = [waits[first : first + run_steps] for first in range(len(waits) - run_steps + 1)]
                assert [len(used & {*run}) for run in runs] == [1] * len(runs)
                found.add(tuple(sorted(used)))
        assert len(found) == run_steps


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_goals_of_motions_are_refused_for_actions_that_do_not_translate_the_tool(mode: str) -> None:
    config().fit_to_control_mode(mode)
    chosen = config(goal_of_each_motion=True)
    if mode.startswith("pd_ee_delta"):
        chosen.fit_to_control_mode(mode)
        return
    with pytest.raises(SpecMismatchError, match=rf"translate the tool.*{mode}.*goal_of_each_motion to false"):
        chosen.fit_to_control_mode(mode)


class TestWaitingOn:
    def test_an_arm_rests_until_its_first_motion(self) -> None:
        given = waits_then_moves()
        given[STATE_KEY][:, 1] = AT_REST_M / 2 / 10**0.5  # it settles
        given[STATE_KEY][1, 2] = 2 * AT_REST_M  # of one episode, somebody pushes it, and it comes back

        rests = episodes_of(given, config(), training=False).rests

        assert rests[0].tolist() == [False, True, True, True, False]
        assert rests[1].tolist() == [False, True, False, False, False]

    def test_a_chunk_after_waiting_on_is_the_same_motion_later(self) -> None:
        given = waits_then_moves()
        given[ACTION_KEY][..., -1] = 1.0  # the gripper is held open
        given[ACTION_PADDING_KEY][:, -2:] = True
        before = episodes_of(given, config(), training=False)
        n_rows = torch.randint(0, CHUNK, before.steps.shape)

        after = after_waiting(before, n_rows)

        waiting = torch.tensor([0.0] * 6 + [1.0])
        for row in range(N_EPISODES):
            for step in range(N_STEPS):
                n = int(n_rows[row, step]) if 1 <= step <= 3 else 0  # not once it has moved
                expected = torch.cat([waiting.expand(n, -1), before.actions[row, step, : CHUNK - n]])
                assert torch.equal(after.actions[row, step], expected)
                assert torch.equal(after.counts[row, step, n:], before.counts[row, step, : CHUNK - n])
