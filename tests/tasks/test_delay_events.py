"""Events of the delay: a distractor that is only seen, a motion that erases what the body has stored."""

from typing import Any

import numpy as np
import pytest

from tests.tasks.made_tasks import make
from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.arm.interference import delay_motion
from vla_eval.tasks.memory_env import PARK_X_M

SEED = 2


def states(task: str, **kwargs: Any) -> tuple[list[np.ndarray], list[list[str]], set[int]]:
    """Robot and items at each step, the decoys that can be seen, and the right candidates."""
    env = make(task, **kwargs)
    env.reset(seed=[SEED])
    bodies, seen = [], []
    for _ in range(int(env._response_step[0]) + 4):
        parts = [env.agent.robot.get_qpos(), *(actor.pose.raw_pose for actor in env.candidates)]
        bodies.append(np.concatenate([part[0].numpy() for part in parts]))
        seen.append([decoy.name for decoy in env.decoys if float(decoy.pose.p[0, 0]) < PARK_X_M - 1])
        env.step(env.hold_action())
    right = set(env.right_candidates(0))
    env.close()
    return bodies, seen, right


@pytest.mark.parametrize(("task", "cue_steps"), [("RememberShape9-v0", 5), ("ChainOfColors3-v0", 15)])
def test_a_distractor_is_seen_in_the_middle_of_the_delay_and_touches_nothing(
    task: str, cue_steps: int
) -> None:
    plain, nothing, _ = states(task)
    distracted, seen, right = states(task, distract_steps=3)
    np.testing.assert_array_equal(plain, distracted)
    assert not any(nothing)
    # A delay of five steps: one before, three with the distractor, one after.
    assert [step for step, names in enumerate(seen) if names] == [cue_steps + 1, cue_steps + 2, cue_steps + 3]
    names = {name for at_step in seen for name in at_step}
    assert len(names) == 1
    env = make(task)
    assert names.isdisjoint(f"{env.items[index].name}_decoy" for index in right)


def test_a_distractor_that_cannot_be_is_refused() -> None:
    with pytest.raises(TaskArgumentError, match="distract_steps=6: expected 0 to 5, the steps of the delay"):
        make("RememberColor3-v0", distract_steps=6)
    with pytest.raises(TaskArgumentError, match="every item is right or shown"):
        make("RememberColor3-v0", n_items=2, swap_cue=1, distract_steps=2)


@pytest.mark.parametrize(("n_steps", "n_out"), [(1, 0), (2, 1), (5, 2), (10, 5), (23, 11)])
def test_a_motion_in_the_delay_leads_out_as_often_as_back(n_steps: int, n_out: int) -> None:
    motions = [delay_motion(step, begins=5, ends=5 + n_steps) for step in range(40)]
    moving = [motion for motion in motions if motion is not None]
    assert len(moving) == n_steps
    assert sum(motion.y > 0 for motion in moving) == sum(motion.y < 0 for motion in moving) == n_out
    assert moving[-1].gripper == 1.0


def test_a_motion_in_the_delay_replaces_the_action_there_and_nowhere_else() -> None:
    env = make("RememberColor3-v0", move_in_delay=True)
    env.reset(seed=[SEED])
    asked = np.full((1, 7), 0.1, dtype=np.float32)
    executed = []
    for _ in range(12):
        env.step(asked)
        executed.append(env.executed_action[0])
    env.close()
    assert asked.tolist() == np.full((1, 7), 0.1, dtype=np.float32).tolist()  # the caller's is untouched
    for step, action in enumerate(executed):
        motion = delay_motion(step, begins=5, ends=10)
        expected = asked[0] if motion is None else np.array([0, motion.y, 0, 0, 0, 0, motion.gripper])
        np.testing.assert_allclose(action, expected)
