"""Checkpoints of a small ACT and a small π0, policies made of them, and what those are given."""

import contextlib
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig

from vla_eval.checkpoints.files import TrainingFacts
from vla_eval.checkpoints.loading import make_empty_policy
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import EnvSpec
from vla_eval.testing.tiny_models import (
    TINY_POLICY,
    make_tiny,
    tiny_paligemma,
    tiny_resnet,
    write_tiny_smolvlm,
    write_tiny_tokenizer,
)

TASK = "RememberColor3-v0"
FAKE = EnvSettings(task=TASK, simulator="fake", cameras=("base_camera", "hand_camera"))
STATISTICS_SHAPES = {
    "observation.images.base": (3, 1, 1),
    "observation.images.wrist": (3, 1, 1),
    "observation.state": (10,),
    "action": (7,),
}
FACTS = TrainingFacts(
    run="r",
    dataset="RememberColor3-v0",
    dataset_sha256="d" * 64,
    task=TASK,
    state="eef",
    images={"observation.images.base": (128, 128), "observation.images.wrist": (128, 128)},
    fps=20.0,
    action_names=("dx", "dy", "dz", "drx", "dry", "drz", "gripper"),
    control_mode="pd_ee_delta_pose",
    run_seed=0,
)


@pytest.fixture(scope="module")
def env() -> EnvSpec:
    spec: EnvSpec = make_env(FAKE).spec
    return spec


def context_for(env: EnvSpec) -> PolicyContext:
    return PolicyContext(name="p", env=env, chunking=ChunkingSpec(n_action_steps=4), n_candidates=3)


def with_features(config: Any, n_state: int = 10, image: tuple[int, int, int] = (3, 128, 128)) -> Any:
    config.input_features = {
        "observation.images.base": PolicyFeature(FeatureType.VISUAL, image),
        "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, image),
        "observation.state": PolicyFeature(FeatureType.STATE, (n_state,)),
    }
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    return config


def statistics(n_state: int = 10) -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(0)
    shapes = {**STATISTICS_SHAPES, "observation.state": (n_state,)}
    names = ("mean", "std", "min", "max", "q01", "q99")
    return {key: {name: rng.uniform(0.5, 0.9, shape) for name in names} for key, shape in shapes.items()}


def save(config: Any, folder: Path, n_state: int = 10, preprocessors: Any = None) -> Path:
    torch.manual_seed(0)
    make_empty_policy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics(n_state)):
        pipeline.save_pretrained(folder)
    return folder


def act_config() -> ACTConfig:
    return ACTConfig(
        device="cpu",
        chunk_size=8,
        n_action_steps=8,
        pretrained_backbone_weights=None,
        push_to_hub=False,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
    )


@pytest.fixture(scope="module", autouse=True, params=["small", pytest.param("real", marks=pytest.mark.slow)])
def backbone(request: pytest.FixtureRequest) -> Iterator[str]:
    """ACT's ResNet-18, or one convolution in its place."""
    with tiny_resnet() if request.param == "small" else contextlib.nullcontext():
        yield request.param


@pytest.fixture(scope="module")
def act(backbone: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(with_features(act_config()), tmp_path_factory.mktemp("act") / "model")


@pytest.fixture(scope="module")
def diffusion(backbone: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """It reads two frames in time, and takes its noise from outside."""
    config = DiffusionConfig(
        device="cpu",
        push_to_hub=False,
        horizon=8,
        n_action_steps=4,
        noise_scheduler_type="DDIM",
        num_inference_steps=2,
        down_dims=(16, 32),
        n_groups=4,
        diffusion_step_embed_dim=16,
        spatial_softmax_num_keypoints=4,
    )
    return save(with_features(config), tmp_path_factory.mktemp("diffusion") / "model")


@pytest.fixture(scope="module")
def smolvla(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("smolvla")
    config = SmolVLAConfig(
        device="cpu",
        push_to_hub=False,
        chunk_size=8,
        n_action_steps=8,
        num_steps=2,
        num_vlm_layers=2,
        resize_imgs_with_padding=(64, 64),
        load_vlm_weights=False,
        vlm_model_name=str(write_tiny_smolvlm(folder / "model" / "vlm")),
    )
    return save(with_features(config), folder / "model")


@pytest.fixture(scope="module")
def pi0(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pi0")
    tokenizer = write_tiny_tokenizer(folder / "model" / "tokenizer")
    fields = {**TINY_POLICY, "image_resolution": (56, 56)}
    config = with_features(PI0Config(device="cpu", push_to_hub=False, **fields))
    processing: Any = importlib.import_module("lerobot.policies.pi0.processor_pi0")
    step = processing.TokenizerProcessorStep
    with pytest.MonkeyPatch.context() as patch, tiny_paligemma("pi0"):
        # Where a full run has the gated tokenizer in the cache, a test has a folder.
        patch.setattr(
            processing,
            "TokenizerProcessorStep",
            lambda **fields: step(**{**fields, "tokenizer_name": str(tokenizer)}),
        )
        return save(config, folder / "model")


@pytest.fixture(params=["act", "pi0"])
def make(request: pytest.FixtureRequest, env: EnvSpec) -> Callable[..., LeRobotPolicy]:
    folder = request.getfixturevalue(request.param)
    maker: Any = make_lerobot if request.param == "act" else make_tiny
    return lambda **args: maker(context_for(env), **{"checkpoint": str(folder), **args})


def start(slot: int = 0, seed: int = 1, run: int = 0, row: int = 0) -> EpisodeStart:
    return EpisodeStart(
        slot=slot, task=TASK, seed=seed, run=run, instruction="touch it", horizon_steps=60, row=row
    )


def observation(step: int = 0, level: int = 100) -> Observation:
    picture = np.full((128, 128, 3), level, dtype=np.uint8)
    pose = np.array([0, 0, 0.2, 0, 1, 0, 0], dtype=np.float32)
    return Observation(
        step=step,
        images={"base_camera": picture, "hand_camera": picture},
        state={"tcp_pose": pose, "qpos": np.zeros(9, np.float32), "qvel": np.zeros(9, np.float32)},
    )


def window(slot: int = 0, *frames: Observation) -> ObservationWindow:
    return ObservationWindow(slot=slot, frames=frames or (observation(),))


def copied(source: Path, target: Path) -> Path:
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target
