"""Policies that learn from rewards: train, kill, resume, evaluate, by their recipes at a tiny size."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from tests.data.failed_episodes import let_fail
from tests.training import tiny_trainings
from tests.training.tiny_trainings import SHORT, TASK, context
from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import DatasetError, RecipeError
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.training.finetune import finetune
from vla_eval.training.job import training_job

offline_with_a_cache_of_its_own = tiny_trainings.offline_with_a_cache_of_its_own
KilledAt = Callable[[int], AbstractContextManager[None]]


def tiny(recipe: str, dataset: Path, out: Path, **changes: Any) -> FinetuneConfig:
    policy = {"width": 8, "hidden": 8, "n_sampled_actions": 2, **changes.pop("policy", {})}
    return FinetuneConfig(
        policy=recipe,
        dataset=str(dataset),
        out=str(out),
        run_seed=3,
        finetune={**SHORT, "policy": policy, **changes},
        device="cpu",
        allow_unreplayed=True,
    )


def weights(run: Path) -> dict[str, torch.Tensor]:
    return dict(load_file(find_checkpoint(run) / "model.safetensors"))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("recipe", ["cql", "cql_published", "iql"])
def test_a_run_that_was_killed_ends_with_the_very_weights_of_one_that_was_not(
    recipe: str, recorded: Path, tmp_path: Path, killed_at: KilledAt
) -> None:
    let_fail(recorded, 1)
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    lines: list[str] = []
    finetune(tiny(recipe, recorded, straight), say=lines.append)
    with killed_at(3):
        finetune(tiny(recipe, recorded, broken))
    finetune(tiny(recipe, recorded, broken))
    one, other = weights(straight), weights(broken)
    assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    slow = {key: values for key, values in one.items() if ".targets." in key}
    assert bool(slow) is (recipe != "cql_published")
    for key, values in slow.items():  # they follow, and lag behind
        assert not torch.equal(values, one[key.replace(".targets.", ".critics.")])
    imitates = recipe == "cql_published"
    assert f"failed episodes: 1 of 4, {'left out' if imitates else 'kept'}" in lines
    n_frames = 55 - 14 * imitates
    assert any(f"{n_frames} of {n_frames} frames" in line for line in lines)

    assert load_policy_recipe(str(straight)).value.default_n_action_steps == 1
    every_step = ChunkingSpec(n_action_steps=1)
    policy = make_lerobot(replace(context(), chunking=every_step), checkpoint=str(straight))
    env = make_env(EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera")))
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=6)
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=every_step))
    assert record.n_inferences == 6


def test_rewards_come_from_decoded_frames_alone(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"decode_ahead is false; .* rewards"):
        training_job(tiny("iql", recorded, tmp_path / "o", decode_ahead=False))


def test_failures_can_be_left_out(recorded: Path, tmp_path: Path) -> None:
    let_fail(recorded, 1)
    job = training_job(tiny("iql", recorded, tmp_path / "o", failed_episodes="leave_out"))
    assert job.dataset.left_out == (1,)
    let_fail(recorded, 0, 1, 2, 3)
    with pytest.raises(DatasetError, match="none in which the success rule ever held"):
        training_job(tiny("iql", recorded, tmp_path / "o", failed_episodes="leave_out"))
