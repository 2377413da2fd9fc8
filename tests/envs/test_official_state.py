"""What scripted controls are given of official episodes, read from stand-ins with the official attributes."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vla_eval.envs.official import OfficialEpisode
from vla_eval.envs.official_state import read_bodies, read_candidates
from vla_eval.errors import SpecMismatchError
from vla_eval.tasks.catalog import SUITES, task_spec
from vla_eval.tasks.catalogs.official_catalog import n_candidates

CUE_STEPS, DELAY_STEPS = 2, 1
REVEALED = CUE_STEPS + DELAY_STEPS
HIDDEN_M = 1000.0


def row(name: str) -> Any:
    return task_spec(f"mikasa_vla/{name}-VLA-v0")


def actor(*position_m: float, quaternion: tuple[float, ...] = (1, 0, 0, 0)) -> Any:
    pose = SimpleNamespace(p=torch.tensor([position_m]), q=torch.tensor([quaternion], dtype=torch.float32))
    return SimpleNamespace(pose=pose, linear_velocity=torch.tensor([[0.0, 0.3, 0.0]]))


def arm(*tcp_m: float, is_static: bool = True) -> Any:
    robot = SimpleNamespace(get_qpos=lambda: torch.full((1, 9), 0.04))
    return SimpleNamespace(
        tcp=actor(*tcp_m), robot=robot, is_static=lambda limit_rad_s: torch.tensor([is_static])
    )


def with_items(**attributes: Any) -> Any:
    """A RememberColor3: the second of three cubes is right."""
    phases = {
        "cue_steps_per_env": torch.tensor([CUE_STEPS]),
        "empty_steps_per_env": torch.tensor([DELAY_STEPS]),
    }
    cubes = {key: actor(0.0, 0.1 * key, HIDDEN_M) for key in range(3)}
    places = {key: torch.tensor([[0.0, 0.1 * key, 0.02]]) for key in range(3)}
    known = {"cubes": cubes, "initial_poses": places, "true_color_indices": torch.tensor([1])}
    return SimpleNamespace(**{**phases, **known, "agent": arm(0, 0, 0.3), "GOAL_THRESH": 0.05, **attributes})


def reveal(env: Any) -> None:
    env.cubes = {key: actor(*place[0].tolist()) for key, place in env.initial_poses.items()}


def test_before_the_reveal_items_are_where_they_will_lie() -> None:
    env = with_items()
    episode = OfficialEpisode(row("RememberColor3"), env)
    state = episode.true_state()
    assert state is not None
    assert (state.phase, state.response_step, state.target) == ("cue", REVEALED, 1)
    assert state.shown_candidates == (1,)
    np.testing.assert_allclose(state.candidate_positions_m[:, 2], 0.02)
    episode.note(CUE_STEPS)
    assert episode.phase == "delay"


def test_after_the_reveal_items_are_where_they_are_now() -> None:
    env = with_items()
    env.cubes[2] = actor(0.3, 0.0, 0.02)  # pushed away
    assert read_candidates(row("RememberColor3"), env, revealed=True).positions_m[2].tolist() == [  # type: ignore[union-attr]
        pytest.approx(0.3),
        0.0,
        pytest.approx(0.02),
    ]


def test_the_first_item_at_which_the_arm_rests_is_the_first_choice() -> None:
    env = with_items()
    episode = OfficialEpisode(row("RememberColor3"), env)
    reveal(env)
    for step, tcp_m, is_static in (
        (REVEALED - 1, (0.0, 0.1, 0.05), True),  # before the reveal: no choice
        (REVEALED, (0.0, 0.0, 0.05), False),  # in passing: no choice
        (REVEALED + 1, (0.0, 0.2, 0.05), True),
        (REVEALED + 2, (0.0, 0.1, 0.08), True),  # 6 cm away, and the threshold is 5
        (REVEALED + 3, (0.0, 0.1, 0.05), True),
    ):
        env.agent = arm(*tcp_m, is_static=is_static)
        episode.note(step)
    status = episode.status(success=True)
    assert (status.first_choice, status.touched_candidates, status.n_wrong_choices) == (2, (2, 1), 1)
    assert (status.target, status.n_candidates, status.chance_success) == (1, 3, pytest.approx(1 / 3))
    assert status.candidate_places == (0, 1, 2)  # from the right as the robot sees it: -y


def test_the_imposter_is_the_right_item_and_the_cue_shows_all_others() -> None:
    places = {key: torch.tensor([[0.0, 0.1 * key, 0.02, 1, 0, 0, 0]]) for key in range(3)}
    env = with_items(_manip_raw_poses=places, imposter_key=torch.tensor([2]))
    state = OfficialEpisode(row("FindImposterColor3"), env).true_state()
    assert state is not None and (state.target, state.shown_candidates) == (2, (0, 1))
    np.testing.assert_allclose(state.candidate_positions_m, [[0, 0, 0.02], [0, 0.1, 0.02], [0, 0.2, 0.02]])


def mugs(**attributes: Any) -> Any:
    names = ("mug_left", "mug_center", "mug_right")
    actors = {name: actor(0.0, 0.2 * (i - 1), 0.05 + HIDDEN_M) for i, name in enumerate(names)}
    known = {"HEIGHT_OFFSET": HIDDEN_M, "cup_with_ball_number": torch.tensor([2]), "GOAL_THRESH": 0.08}
    known["cue_steps_per_env"] = torch.tensor([CUE_STEPS])
    return SimpleNamespace(**{**actors, **known, "agent": arm(0, 0, 0.3), **attributes})


def test_mugs_that_are_shown_above_the_table_stand_on_it() -> None:
    found = read_candidates(row("ShellGameTouch"), mugs(), revealed=False)
    assert found is not None and found.target == 2
    np.testing.assert_allclose(found.positions_m[:, 2], 0.05, atol=1e-4)


def test_shuffled_mugs_are_where_the_last_swap_leaves_them() -> None:
    slots = torch.tensor([[[0.0, -0.2, 0.05], [0.0, 0.0, 0.05], [0.0, 0.2, 0.05]]])
    swaps = torch.tensor([[[0, 1, 2], [1, 0, 2], [2, 0, 1]]])  # the slot of each mug after 0, 1, 2 swaps
    env = mugs(slot_positions=slots, slot_of_mug=swaps, num_swaps_per_env=torch.tensor([1]))
    found = read_candidates(row("ShellGameShuffleTouch"), env, revealed=False)
    assert found is not None
    np.testing.assert_allclose(found.positions_m[:, 1], [0.0, -0.2, 0.2], atol=1e-6)


def test_a_pushed_mug_is_chosen_and_has_its_goal_ahead_of_its_first_place() -> None:
    env = mugs()
    for index, name in enumerate(("mug_left", "mug_center", "mug_right")):
        setattr(env, name, actor(0.0, 0.2 * (index - 1), 0.05))
    episode = OfficialEpisode(row("ShellGamePush"), env)
    env.mug_center = actor(0.03, 0.0, 0.05)
    episode.note(CUE_STEPS)
    state = episode.true_state()
    assert state is not None and state.touched_candidates == (1,)
    assert state.bodies["mug_1"].position_m[0] == pytest.approx(0.03)
    assert state.bodies["goal_1"].position_m[0] == pytest.approx(0.1)


def test_the_goal_of_a_peg_is_its_first_place_turned_by_the_angle_asked_for() -> None:
    env = SimpleNamespace(
        peg=actor(0.1, 0.0, 0.025), initial_rotations=torch.tensor([0.5]), target_angle=torch.tensor([0.25])
    )
    bodies = read_bodies(row("RotateLenientPos"), env, None, np.array([[0.0, 0.05, 0.025]]))
    assert bodies["goal"].yaw_rad == pytest.approx(0.75)
    assert bodies["goal"].position_m.tolist() == [0.0, 0.05, 0.025]
    assert bodies["peg"].position_m[0] == pytest.approx(0.1)


def test_a_task_without_controls_gives_nothing() -> None:
    episode = OfficialEpisode(row("TimedTransferEasy"), SimpleNamespace())
    assert episode.true_state() is None
    assert episode.status(success=False).n_candidates == 0


def test_an_attribute_that_another_version_lacks_is_named() -> None:
    env = with_items()
    del env.true_color_indices
    with pytest.raises(SpecMismatchError, match="expected the attribute 'true_color_indices'"):
        OfficialEpisode(row("RememberColor3"), env)


def test_45_of_the_90_tasks_have_scripted_controls() -> None:
    # Remember 18, FindImposter 9, ShellGame 7, Intercept and InterceptGrab 6, Rotate 4, TakeItBack 1.
    assert sum(bool(spec.oracle) for spec in SUITES["mikasa_vla_90"].values()) == 45
    assert all(bool(spec.oracle) == (spec.true_state != "none") for spec in SUITES["mikasa_vla_90"].values())


@pytest.mark.parametrize(
    ("task", "n"), [("RememberColor9", 9), ("RememberShapeAndColor3x2", 6), ("ShellGamePush", 3)]
)
def test_the_number_of_candidates_is_in_the_name(task: str, n: int) -> None:
    assert n_candidates(task) == n
    assert row(task).chance_success == pytest.approx(1 / n)
