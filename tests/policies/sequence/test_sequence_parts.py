"""Cores over time and encoders of images: what they answer, keep and forget."""

import pytest
import torch
from torch import Tensor

from vla_eval.policies.sequence.cores import Core, make_core
from vla_eval.policies.sequence.encoders import Keypoints, Nature
from vla_eval.policies.sequence.sizes import CORES

WIDTH, N_STEPS = 8, 12


def core_named(name: str, *, context_steps: int = 40, layers: int = 2) -> Core:
    torch.manual_seed(0)
    return make_core(
        name, width=WIDTH, layers=layers, heads=2, context_steps=context_steps, dropout=0.0
    ).eval()


def steps(n_episodes: int = 2) -> Tensor:
    return torch.randn(n_episodes, N_STEPS, WIDTH, generator=torch.Generator().manual_seed(1))


def answers(core: Core, tokens: Tensor, *, at_once: int) -> Tensor:
    memory, parts = core.begin(len(tokens)), []
    for first in range(0, tokens.shape[1], at_once):
        answer, memory = core(tokens[:, first : first + at_once], memory)
        parts.append(answer.detach())
    return torch.cat(parts, dim=1)


@pytest.mark.parametrize("context_steps", [1, 3, 40])
@pytest.mark.parametrize("name", CORES)
def test_steps_one_by_one_get_the_answers_of_all_steps_at_once(name: str, context_steps: int) -> None:
    core = core_named(name, context_steps=context_steps)
    whole = answers(core, steps(), at_once=N_STEPS)
    for at_once in (1, 5):
        torch.testing.assert_close(answers(core, steps(), at_once=at_once), whole, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", CORES)
def test_a_step_is_answered_from_no_later_one(name: str) -> None:
    core, tokens = core_named(name), steps()
    before = answers(core, tokens, at_once=N_STEPS)
    tokens[:, 7, 0] += 1
    after = answers(core, tokens, at_once=N_STEPS)
    torch.testing.assert_close(after[:, :7], before[:, :7])
    assert not torch.isclose(after[:, 7], before[:, 7]).all()


@pytest.mark.parametrize("name", CORES)
def test_a_core_remembers_the_first_step_if_its_row_says_so(name: str) -> None:
    core, tokens = core_named(name), steps()
    before = answers(core, tokens, at_once=N_STEPS)[:, -1]
    tokens[:, 0, 0] += 1
    assert torch.equal(answers(core, tokens, at_once=N_STEPS)[:, -1], before) is not CORES[name].remembers


@pytest.mark.parametrize("name", CORES)
def test_an_episode_gets_the_same_bits_whatever_is_beside_it(name: str) -> None:
    """Also where the others began earlier: their memories are as old as they are."""
    core, tokens, n_new = core_named(name, context_steps=9), steps(3), 4
    old, young = core(tokens[:, :7], core.begin(3))[1], core.begin(3)
    mixed = tuple(torch.stack([a[0], b[1], b[2]]) for a, b in zip(young, old, strict=True))
    all_young, _ = core(tokens[:, :n_new], young)
    beside_old, _ = core(tokens[:, :n_new], mixed)
    assert torch.equal(all_young[0], beside_old[0])


@pytest.mark.parametrize(("lag", "seen"), [(4, True), (5, False)])
def test_a_transformer_forgets_what_is_older_than_its_layers_see(lag: int, seen: bool) -> None:
    """Two layers of three steps see the last five: 2 · (3 - 1) before the newest."""
    core, tokens = core_named("transformer", context_steps=3), steps()
    before = answers(core, tokens, at_once=1)[:, -1]
    tokens[:, -1 - lag, 0] += 1
    assert torch.equal(answers(core, tokens, at_once=1)[:, -1], before) is not seen


def test_keypoints_are_where_a_colour_stands_out_from_the_image() -> None:
    """A map that measures redness finds the red square, however small it is in the image."""
    encoder = Keypoints(image_px=64, outputs=4)
    with torch.no_grad():
        for layer in (encoder.features[0], encoder.features[2], encoder.features[4]):
            layer.weight.zero_()
            layer.bias.zero_()
        encoder.features[0].weight[0, :, 2:6, 2:6] = torch.tensor([1.0, -0.5, -0.5])[:, None, None] / 16
        encoder.features[2].weight[0, 0, 1, 1] = 1.0
        encoder.features[4].weight[0, 0] = 1.0
        encoder.reads.weight.zero_()
        encoder.reads.bias.zero_()
        encoder.reads.weight[0, 0] = encoder.reads.weight[1, 32] = 1.0
        image = torch.full((1, 3, 64, 64), 0.2)
        image[:, :, 40:44, 12:16] = torch.tensor([1.0, -1.0, -1.0])[:, None, None]
        x, y = encoder(image)[0, :2].tolist()
    assert (x, y) == pytest.approx((-1 + 2 * 3 / 15, -1 + 2 * 10 / 15), abs=0.01)  # the 4th of 16 places


@pytest.mark.parametrize("image_px", [64, 128])
def test_encoders_take_the_sizes_of_images_that_are_recorded(image_px: int) -> None:
    for encoder in (Keypoints(image_px=image_px, outputs=5), Nature(image_px=image_px, outputs=5)):
        assert encoder(torch.rand(2, 3, image_px, image_px)).shape == (2, 5)


def test_the_encoder_of_the_baselines_has_their_size() -> None:
    """9216 inputs of the last layer for 128 pixels, as in RATE (CognitiveAISystems/RATE, commit 5aa88f0)."""
    assert Nature(image_px=128, outputs=64)[7].in_features == 9216
