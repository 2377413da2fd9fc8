"""The stages on a real arm, simulated: what is seen when, and what counts."""

import importlib
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.tasks.made_tasks import make
from tests.tasks.test_swapped_cue import held
from vla_eval.chunking import ChunkingSettings
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.tasks.memory_env import PARK_X_M
from vla_eval.tasks.real_stages import COLORS, STAGES, Stage, stage_of
from vla_eval.tasks.real_twin import drawn
from vla_eval.testing import check_task

SEED = 3


def seen(env: Any) -> tuple[list[int], bool]:
    """Return the cubes that are on the table, and whether the cover is."""
    x = env.candidate_positions_m()[0, :, 0]
    return [int(i) for i in np.flatnonzero(x < PARK_X_M - 1)], float(env.cover.pose.p[0, 0]) < PARK_X_M - 1


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_cubes_and_cover_are_on_the_table_as_the_stage_says(stage: Stage) -> None:
    env = make(stage.twin_id)
    env.reset(seed=[SEED])
    target, slot_m = int(env.target_index()[0]), env._slots[0, int(env.target_index()[0])]
    assert env.wording(0) == {"color": COLORS[target]}
    expected = {
        "visible": {"response": ([0, 1, 2], False)},
        "thrown_in": {"cue": ([target], False), "response": ([0, 1, 2], False)},
        "shuffled": {"cue": ([target], False), "delay": ([], True), "response": ([0, 1, 2], False)},
    }[stage.twin]
    phases = [one.phase for one in stage.phases for _ in range(one.twin_steps)] + ["response"] * 3
    for step, phase in enumerate(phases):
        assert seen(env) == expected[phase], f"step {step}"
        if stage.twin == "thrown_in":  # it stays where it was shown
            assert np.allclose(env.candidate_positions_m()[0, target], slot_m, atol=2e-4), f"step {step}"
        env.step(env.hold_action())


@pytest.mark.parametrize("stage", STAGES[1:], ids=lambda stage: stage.name)
def test_another_cue_moves_no_body_by_a_bit(stage: Stage) -> None:
    drawn, right, _ = held(stage.twin_id)
    swapped, other, _ = held(stage.twin_id, swap_cue=1)
    assert other != right
    for step, (one, two) in enumerate(zip(drawn, swapped, strict=True)):
        np.testing.assert_array_equal(one, two, err_msg=f"step {step}")


def played(policy: str, stage: Stage, seeds: range) -> list[EpisodeRecord]:
    env = make_env(EnvSettings(task=stage.twin_id, kwargs={"robot": "so100"}, privileged=True))
    chunking = ChunkingSettings().at(1)
    context = PolicyContext(name=policy, env=env.spec, chunking=chunking, n_candidates=len(COLORS))
    made = make_from_adapter(policy, context, {})
    records = []
    for seed in seeds:
        start = EpisodeStart(
            slot=0,
            task=stage.twin_id,
            seed=seed,
            run=0,
            instruction=stage.instruction,
            horizon_steps=sum(one.twin_steps for one in stage.phases) + 40,
        )
        records += rollout(env, made, [start], RolloutSettings(chunking=chunking))
    env.close()
    return records


def test_the_small_arm_lifts_the_right_cube_and_holds_it_to_the_end() -> None:
    assert [one.success_at_end for one in played("oracle", stage_of("CubesShuffled"), range(3))] == [True] * 3


def test_to_lift_a_wrong_cube_is_a_choice_and_no_success() -> None:
    for record in played("cue_blind", stage_of("CubesShuffled"), range(1, 3)):
        assert record.touched_candidates and record.first_choice != record.target
        assert (record.outcome, record.first_choice_success) == ("failure", False)


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_they_keep_the_contract_of_a_task(stage: Stage) -> None:
    check_task(stage.twin_id)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_has_an_id_in_gymnasium(stage: Stage) -> None:
    importlib.import_module("vla_eval.tasks.register")
    assert gymnasium.registry[stage.twin_id].kwargs == {"task": stage.twin_id}
    assert f"real_twin_maniskill/{stage.name}-v0" in gymnasium.registry


def test_gymnasium_makes_a_stage_with_the_arm_that_is_asked_for() -> None:
    importlib.import_module("vla_eval.tasks.register")
    env: Any = gymnasium.make("real_twin/CubeVisible-v0", robot="so100", cameras=["base_camera"])
    observation, info = env.reset(seed=3)
    color, _ = drawn(3)
    assert info["instruction"] == f"Pick the {COLORS[color]} cube"
    assert observation["state"]["qpos"].shape == (6,)
    _, _, terminated, truncated, info = env.step(env.unwrapped.hold_action())
    assert (terminated, truncated, info["phase"]) == (False, False, "response")
    env.close()
