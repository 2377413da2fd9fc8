"""Policies to measure a server with: one that computes nothing, and a transformer with random weights."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
import torch
from lerobot.policies import make_pre_post_processors

from vla_eval.checkpoints.loading import config_class, make_empty_policy
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.features import ACTION_KEY, ACTION_NAMES, CAMERA_KEYS, STATE_KEY, STATE_NAMES
from vla_eval.models.families import FAMILIES, TINY_POLICY
from vla_eval.models.shared.original import with_features
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import PolicySpec
from vla_eval.testing.tiny_models import Sizes, tiny_paligemma, write_tiny_tokenizer
from vla_eval.training.model import tokenizer_from

SMALL = Sizes(depth=4, width=256, expert_width=128)
SMALL_CHUNK_SIZE = 8
IMAGE_PX = 128
STILL_CHUNK_SIZE = 8
STATES = ("tcp_pose", "qpos", "qvel")


class StillPolicy:
    """Reads two images and the proprioception, and returns zeros: what is left is the way to it and back."""

    def __init__(self, name: str) -> None:
        self.spec = PolicySpec(
            name=name, reads="last", cameras=tuple(CAMERA_KEYS), states=STATES, chunk_size=STILL_CHUNK_SIZE
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
    with tiny_paligemma(_kind(), SMALL):
        return make_lerobot(context, **args)


def write_small_transformer(folder: Path) -> int:
    """Save such a policy with few random weights; return how many numbers they are."""
    kind, n_state = _kind(), len(STATE_NAMES["eef"])
    fields = {**TINY_POLICY, "image_resolution": tuple(TINY_POLICY["image_resolution"])}
    fields |= {"chunk_size": SMALL_CHUNK_SIZE, "n_action_steps": SMALL_CHUNK_SIZE}
    config = config_class(kind, where="type")(device="cpu", push_to_hub=False, **fields)
    with_features(config, dict.fromkeys(CAMERA_KEYS.values(), (IMAGE_PX, IMAGE_PX)), state=n_state)
    tokenizer = write_tiny_tokenizer(folder / "tokenizer")
    statistics = {
        key: {"mean": torch.zeros(n), "std": torch.ones(n)}
        for key, n in ((STATE_KEY, n_state), (ACTION_KEY, len(ACTION_NAMES)))
    }
    with tokenizer_from(str(tokenizer), config), tiny_paligemma(kind, SMALL):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            policy = make_empty_policy(config)
        policy.save_pretrained(folder)
        for pipeline in make_pre_post_processors(config, dataset_stats=statistics):
            pipeline.save_pretrained(folder)
    return sum(parameter.numel() for parameter in policy.parameters())


def _kind() -> str:
    """Return the type of the small transformer: the one that tables of tiny models have lerobot build."""
    return next(row.type for row in FAMILIES.values() if row.tiny is not None and row.built_tiny)
