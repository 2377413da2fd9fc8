"""The positive control in other control modes; in `pd_joint_pos` it learns which joints a place takes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training.fitted_policies import policy_config
from vla_eval.checkpoints.files import read_facts
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.environment import EnvSettings
from vla_eval.config.finetuning import FinetuneConfig, FinetuneRecipe
from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POS, JOINT_DELTA_POS, JOINT_POS
from vla_eval.data.derived.changed_actions import copy_with_actions
from vla_eval.data.manifest import encode_actions, read_manifest
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import SpecMismatchError
from vla_eval.features import rotation_columns
from vla_eval.models.memory.action_head import JOINT_UNIT_RAD, REST_RAD, JointLayer
from vla_eval.models.memory.configuration_memory import MikasaMemoryConfig
from vla_eval.models.memory.modeling_memory import MikasaMemoryPolicy, foreseen_alone
from vla_eval.models.memory.network import Answer
from vla_eval.oracles.kinematics import tool_pose
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.tasks.interface import env_spec
from vla_eval.training.dataset import training_dataset
from vla_eval.training.finetune import finetune

TINY = {"channels": 4, "heads": 2, "key": 4, "memory": 8, "hidden": 16, "chunk_size": 3, "n_action_steps": 2}


def dataset_of(recorded: Path, out: Path, mode: str) -> Path:
    """Return a copy of the dataset with actions of a mode: the arm rests."""
    path = out / mode / recorded.name
    rest = np.array([*((0.0,) * 3 if mode == EE_DELTA_POS else REST_RAD), 1.0], dtype=np.float32)
    env = {"control_mode": mode}
    episodes = [
        replace(one, env_kwargs=env, actions=encode_actions(np.tile(rest, (one.n_steps, 1))))
        for one in read_manifest(recorded)
    ]
    recipe = DatasetRecipe(name="joints", tasks=(recorded.name,), env=dict(env))
    copy_with_actions(recorded, path, episodes, recipe)
    return path


def test_a_dataset_of_joint_positions_gives_a_policy_that_answers_in_radians_about_the_rest(
    recorded: Path, tmp_path: Path
) -> None:
    dataset = training_dataset(dataset_of(recorded, tmp_path, JOINT_POS), allow_unreplayed=True)
    config = policy_config(FinetuneRecipe(type="mikasa_memory", policy=TINY), dataset, device="cpu")
    assert config.joint_targets
    torch.manual_seed(0)
    policy = MikasaMemoryPolicy(config)
    seen = {
        **{key: torch.rand(1, 3, 128, 128) for key in config.image_features},
        "observation.state": torch.rand(1, 10),
    }
    shown = policy._remember({key: value[:, None] for key, value in seen.items()}, None)
    chunk = policy.predict_action_chunk(seen, shown)
    assert chunk.shape == (1, 3, 8)
    # Untrained, the layer's output is below 2 in units of 0.1 rad.
    assert (chunk[..., :7] - torch.tensor(REST_RAD)).abs().max() < 2 * JOINT_UNIT_RAD


def test_it_is_trained_without_rotation_and_refused_in_another_mode(
    recorded: Path, tmp_path: Path, no_network: None
) -> None:
    config = FinetuneConfig(
        policy="memory",
        dataset=str(dataset_of(recorded, tmp_path, EE_DELTA_POS)),
        out=str(tmp_path / "run"),
        finetune={"steps": 1, "batch_size": 2, "save_every_steps": 1, "log_every_steps": 1, "policy": TINY},
        device="cpu",
        allow_unreplayed=True,
    )
    folder = finetune(config).checkpoint
    facts = read_facts(folder)
    assert facts is not None
    assert (facts.control_mode, facts.action_names) == (EE_DELTA_POS, CONTROL_MODES[EE_DELTA_POS].dims)
    env = FakeEnv(EnvSettings(task=recorded.name, cameras=("base_camera", "hand_camera"))).spec
    context = PolicyContext(name="p", env=env, chunking=ChunkingSpec(n_action_steps=2), n_candidates=3)
    with pytest.raises(SpecMismatchError, match=f"control mode: expected {EE_DELTA_POS}"):
        make_lerobot(context, checkpoint=str(folder))
    context = replace(context, env=env_spec(control_mode=EE_DELTA_POS, image_size_px=128))
    assert make_lerobot(context, checkpoint=str(folder)).spec.reads == "every"


def test_motions_are_not_looked_for_in_joint_positions() -> None:
    config = MikasaMemoryConfig(goal_of_one_motion=True)
    config.fit_to_control_mode(EE_DELTA_POS)
    with pytest.raises(SpecMismatchError, match="expected actions that translate the tool, found those of"):
        config.fit_to_control_mode(JOINT_POS)


def test_joint_deltas_are_refused_with_what_to_do(recorded: Path, tmp_path: Path) -> None:
    dataset = training_dataset(dataset_of(recorded, tmp_path, JOINT_DELTA_POS), allow_unreplayed=True)
    recipe = FinetuneRecipe(type="mikasa_memory", policy=TINY)
    with pytest.raises(SpecMismatchError, match=r"are for pd_joint_delta_pos. Convert it: mikasa-vla"):
        policy_config(recipe, dataset, device="cpu")


def test_the_layer_learns_the_joints_of_a_place_to_a_hundredth_of_a_radian() -> None:
    rng = np.random.default_rng(0)
    joints = np.array(REST_RAD) + rng.uniform(-0.3, 0.3, (512, 7)) * [1, 1, 0, 1, 0, 1, 0]  # the arm in use
    poses = [tool_pose(one) for one in joints]
    columns = [np.concatenate([pose[:3, 3], pose[:3, 0], pose[:3, 1], [0.08]]) for pose in poses]
    state = torch.tensor(np.stack(columns), dtype=torch.float32)
    wanted = torch.tensor(joints / JOINT_UNIT_RAD, dtype=torch.float32)
    torch.manual_seed(0)
    layer = JointLayer()
    optimizer = torch.optim.AdamW(layer.parameters(), lr=1e-2)
    still = torch.zeros(len(state), 1, 4)
    for step in range(300):
        for group in optimizer.param_groups:
            group["lr"] = 1e-2 * (1 - step / 300)
        loss = (layer(still, state)[:, 0, :7] - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(loss.detach().sqrt()) * JOINT_UNIT_RAD < 0.01  # of joints that vary by 0.17


def test_a_translation_moves_the_place_whose_joints_are_answered() -> None:
    torch.manual_seed(0)
    layer = JointLayer()
    state, moved = torch.rand(1, 10), torch.rand(1, 1, 4)
    elsewhere = state.clone()
    elsewhere[:, :3] += 0.1 * moved[0, :, :3]
    still = torch.cat([torch.zeros(1, 1, 3), moved[..., 3:]], dim=-1)
    torch.testing.assert_close(layer(moved, state), layer(still, elsewhere))


def test_what_is_not_foreseen_is_held_at_the_last_place_that_is() -> None:
    actions = torch.arange(24.0).reshape(1, 3, 8)
    nothing = torch.zeros(1)
    doubts = torch.tensor([[0.0, 0.0, 1.0]])
    answer = Answer(actions, doubts, nothing, nothing, nothing, nothing, nothing)
    held = foreseen_alone(answer, holds_by_zero=False)
    assert torch.equal(held[0, 2], actions[0, 1])


def test_columns_of_the_state_are_those_of_the_kinematics() -> None:
    # At rest the tool points down: quaternion (0, 1, 0, 0) in w, x, y, z.
    pose = tool_pose(REST_RAD)
    columns = rotation_columns(np.array([0, 1, 0, 0], dtype=np.float32))
    np.testing.assert_allclose(np.concatenate([pose[:3, 0], pose[:3, 1]]), columns, atol=1e-6)
