"""Policies to measure a policy server with: one that computes nothing, and a transformer with random weights.

What they do means nothing; how long it takes and how it rounds does.
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any  # lerobot is untyped
from unittest.mock import patch

import numpy as np

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.features import ACTION_KEY, ACTION_NAMES, CAMERA_KEYS, STATE_KEY, STATE_NAMES
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import PolicySpec
from vla_eval.testing.tiny_models import TINY_POLICY, Sizes, tiny_paligemma, write_tiny_tokenizer

SMALL = Sizes(depth=4, width=256, expert_width=128)
SMALL_CHUNK_SIZE = 8
IMAGE_PX = 128
STILL_CHUNK_SIZE = 8
STATES = ("tcp_pose", "qpos", "qvel")


class StillPolicy:
    """Reads two images and the proprioception, and returns zeros: what is left is the way to it and back."""

    def __init__(self, name: str) -> None:
        self.spec = PolicySpec(
            name=name,
            reads="last",
            cameras=tuple(CAMERA_KEYS),
            states=STATES,
            chunk_size=STILL_CHUNK_SIZE,
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """There is nothing to forget."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return zeros."""
        return ActionChunk(actions=np.zeros((STILL_CHUNK_SIZE, len(ACTION_NAMES)), np.float32))


def make_still(context: PolicyContext) -> StillPolicy:
    """Make the policy that computes nothing; an adapter."""
    return StillPolicy(context.name)


def make_small_transformer(context: PolicyContext, **args: Any) -> LeRobotPolicy:
    """Make the small transformer from its checkpoint; an adapter."""
    with tiny_paligemma("pi0", SMALL):
        return make_lerobot(context, **args)


def write_small_transformer(folder: Path) -> int:
    """Save a π0 with few random weights; return how many numbers they are."""
    lerobot_policies: Any = importlib.import_module("lerobot.policies")
    types: Any = importlib.import_module("lerobot.configs")
    processing: Any = importlib.import_module("lerobot.policies.pi0.processor_pi0")
    pi0: Any = importlib.import_module("lerobot.policies.pi0.configuration_pi0")
    torch: Any = importlib.import_module("torch")
    loading: Any = importlib.import_module("vla_eval.checkpoints.loading")
    image = types.PolicyFeature(types.FeatureType.VISUAL, (3, IMAGE_PX, IMAGE_PX))
    fields = {**TINY_POLICY, "image_resolution": tuple(TINY_POLICY["image_resolution"])}
    fields |= {"chunk_size": SMALL_CHUNK_SIZE, "n_action_steps": SMALL_CHUNK_SIZE}
    config = pi0.PI0Config(device="cpu", push_to_hub=False, **fields)
    n_state, n_action = len(STATE_NAMES["eef"]), len(ACTION_NAMES)
    config.input_features = {
        **{key: image for key in CAMERA_KEYS.values()},
        STATE_KEY: types.PolicyFeature(types.FeatureType.STATE, (n_state,)),
    }
    config.output_features = {ACTION_KEY: types.PolicyFeature(types.FeatureType.ACTION, (n_action,))}
    tokenizer = write_tiny_tokenizer(folder / "tokenizer")
    step = processing.TokenizerProcessorStep

    def local(**given: Any) -> Any:
        return step(**{**given, "tokenizer_name": str(tokenizer)})

    statistics = {
        key: {"mean": torch.zeros(n), "std": torch.ones(n)}
        for key, n in ((STATE_KEY, n_state), (ACTION_KEY, n_action))
    }
    with patch.object(processing, "TokenizerProcessorStep", local), tiny_paligemma("pi0", SMALL):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            policy = loading.make_empty_policy(config)
        policy.save_pretrained(folder)
        for pipeline in lerobot_policies.make_pre_post_processors(config, dataset_stats=statistics):
            pipeline.save_pretrained(folder)
    return sum(parameter.numel() for parameter in policy.parameters())
