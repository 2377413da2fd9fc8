"""What a LeRobot policy was trained on is what it is given: a difference is an error with both values."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import (
    FACTS,
    FAKE,
    act_config,
    context_for,
    copied,
    observation,
    save,
    start,
    with_features,
)
from vla_eval.checkpoints.files import write_facts
from vla_eval.chunking import ChunkingSpec
from vla_eval.envs.factory import make_env
from vla_eval.errors import SpecMismatchError
from vla_eval.features import proprioception
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import EnvSpec

pytestmark = pytest.mark.usefixtures("no_network")
backbone, env, act = small_checkpoints.backbone, small_checkpoints.env, small_checkpoints.act


class TestTrainingAgainstEvaluation:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ({"fps": 10.0}, r"control steps per second: expected 10\.0, found 20\.0"),
            ({"state": "joints"}, r"state: expected joints, found eef"),
            (
                {"control_mode": "pd_joint_pos"},
                r"control mode: expected pd_joint_pos, found pd_ee_delta_pose",
            ),
            ({"action_names": ("gripper", *FACTS.action_names[:-1])}, r"action dimensions: expected"),
            (
                {"images": dict(reversed(list(FACTS.images.items())))},
                r"images and their order: expected \('observation.images.wrist'",
            ),
            (
                {"images": {key: (256, 256) for key in FACTS.images}},
                r"size of observation.images.base: expected \(256, 256\), found \(128, 128\)",
            ),
        ],
    )
    def test_what_differs_is_named_with_both_values(
        self, act: Path, tmp_path: Path, env: EnvSpec, change: dict[str, Any], said: str
    ) -> None:
        folder = copied(act, tmp_path)
        write_facts(folder, dataclasses.replace(FACTS, **change))
        with pytest.raises(SpecMismatchError, match=said):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_the_same_is_accepted(self, act: Path, tmp_path: Path, env: EnvSpec) -> None:
        folder = copied(act, tmp_path)
        write_facts(folder, FACTS)
        assert make_lerobot(context_for(env), checkpoint=str(folder)).spec.chunk_size == 8

    def test_without_facts_the_size_of_the_pictures_is_still_compared(
        self, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = save(with_features(act_config(), image=(3, 96, 96)), tmp_path / "m")
        with pytest.raises(SpecMismatchError, match=r"expected \(96, 96\), found \(128, 128\)"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_pictures_that_were_not_scaled_to_one_are_noticed(
        self, act: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = copied(act, tmp_path)
        (state,) = folder.glob("policy_preprocessor_step_*normalizer*.safetensors")
        tensors = load_file(state)
        tensors["observation.images.base.mean"] = torch.full((3, 1, 1), 121.0)
        save_file(tensors, state)
        with pytest.raises(
            SpecMismatchError, match=r"expected statistics in \[0, 1\], found values up to 121"
        ):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_a_camera_that_is_not_mapped_is_an_error_and_no_black_picture(
        self, act: Path, env: EnvSpec
    ) -> None:
        with pytest.raises(SpecMismatchError, match=r"expects the image 'observation.images.wrist', found"):
            make_lerobot(
                context_for(env), checkpoint=str(act), cameras={"base_camera": "observation.images.base"}
            )

    def test_act_masks_no_cameras_so_none_may_be_absent(self, act: Path, env: EnvSpec) -> None:
        with pytest.raises(SpecMismatchError, match=r"does not mask missing cameras"):
            make_lerobot(context_for(env), checkpoint=str(act), absent_cameras=("observation.images.wrist",))

    def test_a_state_of_unknown_size_is_an_error_that_lists_the_kinds(
        self, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = save(with_features(act_config(), n_state=9), tmp_path / "m", n_state=9)
        with pytest.raises(SpecMismatchError, match=r"state of 9 dimensions.*eef \(10\), joints \(25\)"):
            make_lerobot(context_for(env), checkpoint=str(folder))

    def test_the_state_is_computed_as_in_recording(self, tmp_path: Path, env: EnvSpec) -> None:
        folder = save(with_features(act_config(), n_state=25), tmp_path / "m", n_state=25)
        policy = make_lerobot(context_for(env), checkpoint=str(folder))
        seen = policy._inputs.tensors(observation())
        expected = proprioception(observation().state)["joints"]
        assert seen["observation.state"].numpy().tobytes() == expected.tobytes()
        assert seen["observation.images.base"].shape == (3, 128, 128)
        assert float(seen["observation.images.base"].max()) == pytest.approx(100 / 255)

    def test_a_chunk_shorter_than_n_action_steps_is_an_error(self, act: Path, env: EnvSpec) -> None:
        policy = make_lerobot(context_for(env), checkpoint=str(act))
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=9))
        with pytest.raises(SpecMismatchError, match=r"chunks of 8 actions, but n_action_steps=9"):
            rollout(make_env(FAKE), policy, [start()], settings)
