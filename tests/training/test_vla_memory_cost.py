"""What memory adds to the estimate of a fine-tuning."""

from pathlib import Path

import pytest

from tests.policies.vla_memory.tiny_vlas import FAMILIES, made
from vla_eval.training.sample_cost import count, sample_cost
from vla_eval.training.stages import EPISODE_STEPS, STAGES, stage_of

TOKENS = {"memory_tokens": 3, "token_stride": 4, "token_segments": 2}


def tokens_of(policy: object, name: str) -> int:
    config = policy.config  # type: ignore[attr-defined]
    return stage_of(STAGES[config.type](config), name).tokens


@pytest.mark.parametrize("family", FAMILIES)
def test_each_place_adds_an_image_and_each_token_one_to_the_prefix(family: str, tmp_path: Path) -> None:
    plain = made(f"mikasa_{family}", tmp_path)
    frames = made(f"mikasa_{family}", tmp_path, memory_places=2)
    tokens = made(f"mikasa_{family}", tmp_path, **TOKENS)
    vision, language = {
        "smolvla": ("model.vlm_with_expert.vlm.vision_model.x", "model.vlm_with_expert.vlm.x"),
    }.get(family, ("paligemma.model.vision_tower.x", "paligemma.model.x"))
    per_image = tokens_of(plain, vision) // 2  # of two cameras
    assert tokens_of(frames, vision) == 4 * per_image
    assert tokens_of(tokens, language) == tokens_of(plain, language) + 3
    assert tokens_of(tokens, "memory_tokens.gate") == 3


def test_each_writing_is_a_pass_and_those_with_a_loss_are_kept_for_the_backward_pass(tmp_path: Path) -> None:
    # The longest episode has 9 frames: written at 0, 4 and, the sample's own, 8. Two with a gradient.
    policy = made("mikasa_pi0", tmp_path, **TOKENS, window_steps=9)
    assert policy.config.n_passes(EPISODE_STEPS) == (1, 2)
    one, cost = count(policy, policy.config), sample_cost(policy, policy.config)
    assert cost is not None
    assert cost.step_operations == one.forward + 2 * one.step
    plain = made("mikasa_pi0", tmp_path)
    alone = sample_cost(plain, plain.config)
    assert alone is not None and cost.saved_bytes > 2 * alone.saved_bytes


def test_without_a_dataset_the_usual_length_of_an_episode_is_assumed(tmp_path: Path) -> None:
    config = made("mikasa_smolvla", tmp_path, **TOKENS).config
    # 90 frames: 0, 4, …, 88 and the last one, 89.
    assert config.n_passes(EPISODE_STEPS) == (24 - 2, 2)
