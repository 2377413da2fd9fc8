"""What OpenVLA and SpatialVLA both promise: prompt, images, names of fields, padding, precision."""

import operator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.tiny_prompted import BASE, BOTH, OPENVLA, SPATIALVLA, WRIST, Ported, frames, tiny
from vla_eval.errors import (
    MissingInstructionError,
    RecipeError,
    SpecMismatchError,
    TrainingError,
    UnknownNameError,
)

pytestmark = pytest.mark.parametrize("ported", [OPENVLA, SPATIALVLA], ids=["openvla", "spatialvla"])
CALM = {"openvla_oft_tiny": {"image_augmentation": False}, "spatialvla_tiny": {}}
"""Fields with which training changes no image at random."""


@pytest.mark.parametrize("instruction", ["", "  "])
def test_an_empty_instruction_is_an_error(ported: Ported, instruction: str) -> None:
    with pytest.raises(MissingInstructionError, match="empty"):
        ported.prompt_text(instruction)


def test_a_missing_instruction_is_an_error(ported: Ported, recorded: Path) -> None:
    _, before, _ = tiny(ported, recorded)
    batch = frames(chunk=ported.chunk)
    del batch["task"]
    with pytest.raises(MissingInstructionError, match="found none"):
        before(batch)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"dtype": "bfloat"}, "Did you mean 'bfloat16'"),
        ({"n_action_steps": 9}, r"expected 1 to chunk_size \(\d\)"),
        ({"sizes": {"lm_width": 64}}, "Did you mean 'llm_width'"),
        ({"sizes": {"image_px": 57}}, "image_px is 57, expected a multiple of 14"),
        ({"sizes": {"llm_width": -1}}, "llm_width is -1, expected ≥ 0"),
    ],
)
def test_a_wrong_field_is_named(ported: Ported, recorded: Path, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        tiny(ported, recorded, **fields)


def test_a_mistyped_image_is_named(ported: Ported, recorded: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"Did you mean 'observation\.images\.base'"):
        tiny(ported, recorded, pictures=["observation.images.bas"])


def test_only_the_named_images_are_read(ported: Ported, recorded: Path) -> None:
    batch, other = frames(chunk=ported.chunk), frames(chunk=ported.chunk)
    other[WRIST] = 1 - other[WRIST]
    for images, is_same in (([BASE], True), (BOTH, False)):
        policy, before, _ = tiny(ported, recorded, pictures=images, **CALM[ported.recipe])
        first, second = (policy.forward(before(dict(x)))[0] for x in (batch, other))
        assert torch.equal(first, second) == is_same


def test_a_missing_image_is_an_error(ported: Ported, recorded: Path) -> None:
    policy, before, _ = tiny(ported, recorded, pictures=BOTH)
    batch = before(frames(chunk=ported.chunk))
    del batch[WRIST]
    with pytest.raises(SpecMismatchError, match=r"no image 'observation\.images\.wrist'"):
        policy.predict_action_chunk(batch)


def test_samples_together_get_what_they_get_alone(ported: Ported, recorded: Path) -> None:
    policy, before, _ = tiny(ported, recorded, pictures=BOTH)
    batch = frames(chunk=ported.chunk)
    together = policy.predict_action_chunk(before(dict(batch)))
    assert together.shape == (2, ported.chunk, 7)
    for index in range(2):
        one = {key: value[index : index + 1] for key, value in batch.items()}
        alone = policy.predict_action_chunk(before(one))
        torch.testing.assert_close(together[index : index + 1], alone, atol=1e-5, rtol=1e-5)
    # lerobot's own loop executes the first of each chunk.
    torch.testing.assert_close(policy.select_action(before(dict(batch))), together[:, 0])


def test_padded_actions_are_refused_or_left_out(ported: Ported, recorded: Path) -> None:
    policy, before, _ = tiny(ported, recorded)
    batch = before(frames(chunk=ported.chunk))
    batch["action_is_pad"][0, -2:] = True
    policy.eval()
    policy.config.do_mask_loss_for_padding = True
    loss, _ = policy.forward(batch)
    batch["action"][0, -2:] = 0.9
    changed, _ = policy.forward(batch)
    torch.testing.assert_close(changed, loss)
    policy.config.do_mask_loss_for_padding = False
    with pytest.raises(TrainingError, match="beyond its episode's end"):
        policy.forward(batch)


def test_bfloat16_with_recomputed_activations_has_the_same_gradients_nearly(
    ported: Ported, recorded: Path
) -> None:
    losses, norms = [], []
    weights = {key: value.clone() for key, value in tiny(ported, recorded)[0].state_dict().items()}
    for fields in ({"dtype": "float32"}, {"dtype": "bfloat16", "gradient_checkpointing": True}):
        policy, before, _ = tiny(ported, recorded, **CALM[ported.recipe], **fields)
        policy.load_state_dict(weights)
        loss, _ = policy.train().forward(before(frames(chunk=ported.chunk)))
        loss.backward()
        losses.append(loss.item())
        first = operator.attrgetter(ported.layers)(policy.network)[0]
        norms.append(first.mlp.up_proj.weight.grad.float().norm().item())
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    assert norms[1] == pytest.approx(norms[0], rel=0.1)
