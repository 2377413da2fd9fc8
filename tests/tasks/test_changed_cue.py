"""Other changes of the cue, and of how the scene looks: what stays the same does so to the last bit."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.tasks.made_tasks import make
from vla_eval.config.environment import AppearanceSettings, EnvSettings, RenderSettings
from vla_eval.core import Observation
from vla_eval.cue_view import GREY, CueBoxes, CueView, CueViewKind, CueViewSettings
from vla_eval.envs.factory import make_env
from vla_eval.envs.maniskill import ManiSkillEnv
from vla_eval.errors import TaskArgumentError
from vla_eval.probe.worlds import APPEARANCES
from vla_eval.task_state import Phase
from vla_eval.tasks.appearance import turned_hue
from vla_eval.tasks.objects.items import COLORS

SEED = 2
LATE = 2
CAMERAS = ("base_camera", "hand_camera")
Frame = tuple[Observation, Phase, CueBoxes]


def made(task: str, look: AppearanceSettings | None = None, **kwargs: Any) -> ManiSkillEnv:
    env = make_env(
        EnvSettings(
            task=task,
            kwargs=kwargs,
            cameras=CAMERAS,
            render=RenderSettings(wrist_mesh="simplified"),
            appearance=look or AppearanceSettings(),
        )
    )
    assert isinstance(env, ManiSkillEnv)
    return env


def frames(task: str, n: int, look: AppearanceSettings | None = None, **kwargs: Any) -> list[Frame]:
    """Observation, phase and boxes of the cue at each step while the robot holds."""
    return list(_frames(task, n, look, tuple(kwargs.items())))


@functools.cache  # several tests compare with the task as drawn
def _frames(
    task: str, n: int, look: AppearanceSettings | None, kwargs: tuple[tuple[str, Any], ...]
) -> tuple[Frame, ...]:
    env = made(task, look, **dict(kwargs))
    result = env.reset({0: SEED}, render=True)[0]
    found = []
    for _ in range(n):
        found.append((result.observation, result.status.phase, env.cue_boxes(0)))
        result = env.step({0: env.hold_action(0)}, render=frozenset({0}))[0]
    env.close()
    return tuple(found)


def seen(frames: list[Frame], kind: CueViewKind) -> list[Observation]:
    """What a policy sees of these frames."""
    boxes = iter([frame[2] for frame in frames if frame[1] == "cue"])
    view = CueView(settings=CueViewSettings(kind=kind), locate=lambda: next(boxes))
    return [view.seen(observation, phase) for observation, phase, _ in frames]


def equal(one: Observation, other: Observation) -> bool:
    return all(np.array_equal(one.images[name], other.images[name]) for name in CAMERAS)


@pytest.mark.parametrize("task", ["RememberShape3-v0", "ShellGameTouch-v0", "BunchOfColors3-v0"])
def test_of_a_hidden_cue_no_pixel_is_left(task: str) -> None:
    shown, blank = frames(task, 2), frames(task, 2, show_cue=False)
    assert not equal(shown[0][0], blank[0][0])
    assert all(map(equal, seen(shown, "hidden"), seen(blank, "hidden")))


def test_a_hidden_item_is_the_same_in_both_worlds() -> None:
    drawn, other = frames("RememberShape3-v0", 2), frames("RememberShape3-v0", 2, swap_cue=1)
    assert not equal(drawn[0][0], other[0][0])
    assert all(map(equal, seen(drawn, "hidden"), seen(other, "hidden")))


def test_only_the_named_frames_differ_and_no_state() -> None:
    shown = frames("ChainOfColors3-v0", 9, cue_steps=2)  # 6 steps of cue, 2 for each cube
    changed: dict[CueViewKind, Callable[[int], bool]] = {
        "first_frame": lambda step: 2 <= step < 6,  # the first cube is shown until step 1
        "hidden": lambda step: step < 6,
        "hidden_elsewhere": lambda step: step < 6,
        "hidden_later": lambda step: step >= 6,
    }
    assert [phase for _, phase, _ in shown] == ["cue"] * 6 + ["delay"] * 3
    for kind, differs in changed.items():
        for step, (observation, (original, _, _)) in enumerate(zip(seen(shown, kind), shown, strict=True)):
            assert observation.state is original.state
            if (kind, step) != ("first_frame", 1):  # another frame of the same cube
                assert equal(observation, original) != differs(step), (kind, step)


def test_as_much_is_hidden_elsewhere_and_later_as_of_the_cue() -> None:
    shown = frames("RememberColor3-v0", 3, cue_steps=2)
    grey: dict[CueViewKind, int] = {}
    kinds: tuple[CueViewKind, ...] = ("hidden", "hidden_elsewhere", "hidden_later")
    for kind in kinds:
        step = 2 if kind == "hidden_later" else 0
        image = seen(shown, kind)[step].images["base_camera"]
        grey[kind] = int((image == GREY).all(axis=-1).sum())
    (box,) = shown[0][2]["base_camera"]
    area = (box.bottom - box.top) * (box.right - box.left)
    assert set(grey.values()) == {area}
    cue, beside = (seen(shown, kind)[0].images["base_camera"] for kind in kinds[:2])
    inside = (slice(box.top, box.bottom), slice(box.left, box.right))
    assert (cue[inside] == GREY).all()
    np.testing.assert_array_equal(beside[inside], shown[0][0].images["base_camera"][inside])


@pytest.mark.parametrize(
    "task",
    [
        *("RememberColor3-v0", "ChainOfColors3-v0"),
        *(pytest.param(task, marks=pytest.mark.slow) for task in ("ShellGameTouch-v0", "BunchOfColors3-v0")),
    ],
)
def test_a_late_cue_is_the_usual_one_after_steps_without_it(task: str) -> None:
    n_cue = 3 if task.startswith("Chain") else 1
    late = frames(task, LATE + n_cue + 1, cue_steps=1, cue_after_steps=LATE)
    blank = frames(task, LATE, cue_steps=LATE + n_cue, show_cue=False)
    usual = frames(task, n_cue, cue_steps=1)
    for step in range(LATE):
        assert equal(late[step][0], blank[step][0]), step
    assert [phase == "cue" for _, phase, _ in late] == [True] * (LATE + n_cue) + [False]
    for step in range(n_cue):
        box = usual[0][2]["base_camera"][0]
        inside = (slice(box.top, box.bottom), slice(box.left, box.right))
        shown, expected = (
            found.images["base_camera"][inside].astype(int)
            for found in (late[LATE + step][0], usual[step][0])
        )
        # A held arm sags by less than a pixel in the meantime.
        np.testing.assert_allclose(shown, expected, atol=2)
        hidden = late[0][0].images["base_camera"][inside].astype(int)
        assert np.abs(shown - hidden).max() > 20


def test_a_shuffled_cue_moves_no_body_and_leaves_the_right_answer() -> None:
    drawn, shuffled = make("ChainOfColors3-v0"), make("ChainOfColors3-v0", shuffle_cue=True)
    for seed in range(1, 5):
        for env in (drawn, shuffled):
            env.reset(seed=[seed])
        assert shuffled.right_candidates(0) == drawn.right_candidates(0)
        seen_order = tuple(shuffled._seen_sequence[0].tolist())
        assert sorted(seen_order) == sorted(drawn.right_candidates(0))
        assert seen_order != drawn.right_candidates(0)
    for _ in range(24):
        for env in (drawn, shuffled):
            env.step(env.hold_action())
        for one, other in zip(drawn.candidates, shuffled.candidates, strict=True):
            np.testing.assert_array_equal(one.pose.raw_pose, other.pose.raw_pose)
        np.testing.assert_array_equal(drawn.agent.robot.get_qpos(), shuffled.agent.robot.get_qpos())


def test_cubes_that_are_shown_together_cannot_be_shuffled() -> None:
    with pytest.raises(TaskArgumentError, match="shuffle_cue: the cue of this task is not several"):
        make("BunchOfColors3-v0", shuffle_cue=True)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", APPEARANCES)
def test_another_look_changes_images_and_no_state(name: str) -> None:
    usual = frames("RememberColor3-v0", 3, cue_steps=1, delay_steps=1)
    other = frames("RememberColor3-v0", 3, look=APPEARANCES[name], cue_steps=1, delay_steps=1)
    assert other[-1][1] == "response"
    for (one, _, _), (two, _, _) in zip(usual, other, strict=True):
        for state in one.state:
            np.testing.assert_array_equal(one.state[state], two.state[state])
    shown, changed = usual[0][0].images, other[0][0].images
    assert not np.array_equal(shown["base_camera"], changed["base_camera"])
    # The other camera is on the robot.
    assert np.array_equal(shown["hand_camera"], changed["hand_camera"]) == (name == "camera")


def test_hues_turned_by_ten_degrees_stay_nearest_to_themselves() -> None:
    colors = [np.array(color.rgb) / 255 for color in COLORS]
    for index, color in enumerate(colors):
        turned = np.array(turned_hue(tuple(color), APPEARANCES["hue"].hue_deg))
        distances = [float(np.linalg.norm(turned - other)) for other in colors]
        assert int(np.argmin(distances)) == index
        assert distances[index] > 0
    assert turned_hue((1.0, 0.0, 0.0), 120) == pytest.approx((0, 1, 0))
