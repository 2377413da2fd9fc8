"""A policy that LeRobot trained on an arm's own numbers: its state and its actions are the motors."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

from tests.real.test_session import arms as arms
from tests.real.test_session import evaluation, session
from vla_eval.config.real_robot import SIMULATED
from vla_eval.errors import SpecMismatchError
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.real_stages import stage_of

# As a real arm whose zeros nobody has measured: the motors are all that is known of it.
MOTORS_ALONE = dataclasses.replace(
    SIMULATED,
    lerobot={**SIMULATED.lerobot, "views": ["base_camera"]},
    control_mode="motors",
    zeros=None,
    response_seconds=0.5,
)


FRONT = "observation.images.front"


def write_policy(folder: Path, *, n_dims: int = 6, image: str = FRONT) -> Path:
    """Write an ACT of LeRobot's that returns positions near 0, and a recipe for it."""
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(n_dims,)),
            image: PolicyFeature(type=FeatureType.VISUAL, shape=(3, 128, 128)),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(n_dims,))},
        chunk_size=4,
        n_action_steps=4,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    torch.manual_seed(0)
    ACTPolicy(config).save_pretrained(folder / "act")
    numbers = {name: torch.full((n_dims,), value) for name, value in (("mean", 0.0), ("std", 1.0))}
    pixels = {name: torch.full((3, 1, 1), value) for name, value in (("mean", 0.5), ("std", 0.5))}
    stats = {"observation.state": numbers, "action": numbers, image: pixels}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder / "act")
    recipe = folder / "mine.yaml"
    recipe.write_text(
        "version: 1\ndescription: d\nadapter: lerobot\ndefault_n_action_steps: 4\n"
        f"args:\n  checkpoint: {folder / 'act'}\n  device: cpu\n  cameras: {{base_camera: {image}}}\n"
    )
    return recipe


def asked(recipe: Path, out: Path) -> Any:
    stages = (stage_of("CubeVisible"),)
    return evaluation(out, str(recipe), settings=MOTORS_ALONE, stages=stages, n_action_steps=None)


def test_it_is_given_the_motors_and_moves_them(arms: Any, tmp_path: Path) -> None:
    arm = arms(MOTORS_ALONE)
    running = session(arm, asked(write_policy(tmp_path), tmp_path / "run"))
    policy = running.policies.of(running.evaluation.plan[0])
    assert policy.spec.states == ("motors",)
    assert running.run(command="").n_open == 0
    assert [one.n_action_steps for one in read_run(tmp_path / "run").records] == [4, 4, 4]
    # Its positions are near 0 degrees: from where the arm was, every motor is sent that way, a step at most.
    began, then = (np.array(list(arm.sent[index].values())) for index in (0, 1))
    far = np.abs(began) > MOTORS_ALONE.max_step
    assert far.any() and (np.abs(then) < np.abs(began))[far].all()


def test_a_policy_with_another_number_of_motors_is_refused(arms: Any, tmp_path: Path) -> None:
    with pytest.raises(SpecMismatchError, match=r"gives actions of 7 dimensions.*motors"):
        session(arms(MOTORS_ALONE), asked(write_policy(tmp_path, n_dims=7), tmp_path / "run"))


def test_a_scripted_policy_does_not_plan_in_degrees(arms: Any, tmp_path: Path) -> None:
    with_model = dataclasses.replace(MOTORS_ALONE, zeros=SIMULATED.zeros)
    plan = evaluation(tmp_path, settings=with_model, stages=(stage_of("CubeVisible"),))
    with pytest.raises(SpecMismatchError, match="expected a control mode of its joints"):
        session(arms(with_model), plan)
