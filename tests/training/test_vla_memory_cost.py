"""What memory adds to the estimate of a fine-tuning."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.vla_memory.tiny_vlas import FAMILIES, batch_of, made
from tests.testing.script_files import load_script
from vla_eval.models.families import family_of
from vla_eval.models.family import imported
from vla_eval.models.shared.stages import EPISODE_STEPS, stage_of
from vla_eval.training.cost.sample_cost import count, sample_cost

TOKENS = {"memory_tokens": 3, "token_stride": 4, "token_segments": 2}


def tokens_of(policy: object, name: str) -> int:
    config = policy.config  # type: ignore[attr-defined]
    return stage_of(imported(family_of(config.type).stages)(config), name).tokens


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


@pytest.mark.parametrize("family", ["pi0", "pi05"])
def test_a_frozen_language_model_keeps_its_activations_for_the_expert(family: str, tmp_path: Path) -> None:
    # LeRobot computes the attention of both in one tensor, which needs a gradient from the first layer on.
    def policy_for(n_words: int) -> Any:
        return made(family, tmp_path, train_expert_only=True, tokenizer_max_length=n_words).train()

    def estimated(n_words: int) -> float:
        policy = policy_for(n_words)
        return count(policy, policy.config).saved

    language = policy_for(4).model.paligemma_with_expert.paligemma
    hidden = [
        x.out_features for name, x in language.named_modules() if name.endswith(("gate_proj", "up_proj"))
    ]
    assert kept(policy_for(8), 8) - kept(policy_for(4), 4) > 4 * sum(hidden)
    assert estimated(8) - estimated(4) > 4 * sum(hidden)


@pytest.mark.parametrize("family", ["pi0", "pi05"])
def test_an_expert_trained_with_recomputed_activations_has_the_same_gradients(
    family: str, tmp_path: Path
) -> None:
    found = []
    for is_recomputed in (False, True):
        changes = {"train_expert_only": True, "gradient_checkpointing": is_recomputed}
        policy = made(family, tmp_path, **changes).train()
        torch.manual_seed(1)
        loss, _ = policy.forward(batch_of(2))
        loss.backward()
        found.append([x.grad for x in policy.parameters() if x.grad is not None])
    assert len(found[0]) == len(found[1]) > 10
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def kept(policy: Any, n_words: int) -> int:
    """Return how many numbers autograd keeps of one sample."""
    batch = batch_of(1)
    for key in ("observation.language.tokens", "observation.language.attention_mask"):
        batch[key] = batch[key][:, :1].repeat(1, n_words)
    found: int = load_script("activation_constants").saved_bytes(policy, batch)
    return found // torch.float32.itemsize
