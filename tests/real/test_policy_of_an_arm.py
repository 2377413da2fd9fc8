"""A policy that was trained on an arm's motors, by what its checkpoint notes: in the session, and served."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from tests.real.test_motors_policy import MOTORS_ALONE, write_policy
from tests.real.test_session import arms as arms
from tests.real.test_session import evaluation, session
from tests.serving.served_policies import Running
from vla_eval.checkpoints.files import TrainingFacts, write_facts
from vla_eval.config.real_robot import SIMULATED
from vla_eval.errors import RecipeError
from vla_eval.features import CAMERA_KEYS
from vla_eval.robots.rows import SO100
from vla_eval.serving.arm_env import arm_env
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.server import ServerOptions
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.real_stages import stage_of

BASE = CAMERA_KEYS["base_camera"]
STAGE = stage_of("CubeVisible")
FACTS = TrainingFacts(
    run="r",
    dataset="d",
    dataset_sha256="0" * 64,
    task=STAGE.twin_id,
    tasks=(STAGE.twin_id,),
    state="motors",
    images={BASE: (128, 128)},
    fps=20.0,
    action_names=tuple(f"{joint}.pos" for joint in SO100.joints),
    control_mode="motors",
    run_seed=0,
)
# In angles of the arm's model, as the arm is driven by policies whose training is not known.
ANGLES = dataclasses.replace(
    SIMULATED, lerobot={**SIMULATED.lerobot, "views": ["base_camera"]}, response_seconds=0.5
)


def trained(folder: Path, **facts: Any) -> Path:
    write_policy(folder, image=BASE)
    write_facts(folder / "act", dataclasses.replace(FACTS, **facts))
    return folder / "act"


def asked(policy: str, out: Path, settings: Any = ANGLES) -> Any:
    return evaluation(out, policy, settings=settings, stages=(STAGE,), n_action_steps=4)


@pytest.mark.slow
def test_it_drives_the_arm_as_it_was_trained_and_finds_its_camera(arms: Any, tmp_path: Path) -> None:
    running = session(arms(ANGLES), asked(f"mine={trained(tmp_path)}", tmp_path / "run"))
    (entry,) = running.evaluation.policies
    assert running.evaluation.settings(entry).control_mode == "motors"
    assert running.policies.of(running.evaluation.plan[0]).spec.cameras == ("base_camera",)
    assert running.run(command="").n_open == 0


def test_a_policy_of_the_twin_needs_the_zeros_of_the_arm(arms: Any, tmp_path: Path) -> None:
    checkpoint = trained(tmp_path, control_mode="pd_joint_pos")
    with pytest.raises(RecipeError, match="`zeros` is missing"):
        session(arms(MOTORS_ALONE), asked(f"mine={checkpoint}", tmp_path / "run", MOTORS_ALONE))


@pytest.mark.slow
def test_served_it_acts_as_in_the_session(arms: Any, tmp_path: Path) -> None:
    checkpoint = trained(tmp_path)
    session(arms(ANGLES), asked(f"mine={checkpoint}", tmp_path / "here")).run(command="")
    # One row, as here: a network gives a row the same bits only in a pass of as many.
    options = HostOptions(policy=str(checkpoint), device="cpu", max_batch=1)
    server = Running(host_policy(options), ServerOptions(port=0))
    try:
        summary = session(arms(ANGLES), asked(server.url, tmp_path / "there")).run(command="")
    finally:
        server.stop()
    assert (summary.n_open, summary.n_errors) == (0, 0)
    here, there = (
        {one.seed: one.trajectory_sha256 for one in read_run(tmp_path / name).records}
        for name in ("here", "there")
    )
    assert here == there and len(here) == 3


@pytest.mark.parametrize("tasks", [(), ("real/CubeVisible-v0",)])
def test_cameras_of_an_arm_have_the_names_of_its_dataset(tasks: tuple[str, ...]) -> None:
    """Also `wrist`: in the twin its field is that of another name."""
    images = {"observation.images.front": (48, 64), "observation.images.wrist": (32, 64)}
    env = arm_env(dataclasses.replace(FACTS, images=images, tasks=tasks, fps=30.0), task="t")
    assert [(one.name, one.height_px, one.width_px) for one in env.cameras] == [
        ("front", 48, 64),
        ("wrist", 32, 64),
    ]
    assert (env.control_hz, env.action.control_mode) == (30.0, "motors")
    twin = arm_env(FACTS, task="t")
    assert [one.name for one in twin.cameras] == ["base_camera"]
