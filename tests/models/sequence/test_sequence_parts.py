"""Cores over time and encoders of images: what they answer, keep and forget."""

from typing import Any

import pytest
import torch
from torch import Tensor

from vla_eval.errors import VlaEvalError
from vla_eval.models.cores.core import Core
from vla_eval.models.cores.cores import make_core
from vla_eval.models.cores.sizes import CORES
from vla_eval.models.sequence.encoders import (
    FRAMES_AT_ONCE,
    LEAST_VARIANCE,
    Cameras,
    Keypoints,
    Nature,
    ShapesAndColors,
    spatial_softmax,
)
from vla_eval.models.sequence.sizes import ENCODERS

WIDTH, N_STEPS = 8, 12
SMALL_OPTIONS: dict[str, dict[str, Any]] = {
    "decision_transformer": {"head_width": 4},
    "rate": {"head_width": 4, "cached_tokens": 7, "memory_tokens": 2, "valve_heads": 2},
    "gtrxl": {"head_width": 4, "cached_tokens": 7},
    "decision_mamba": {"state": 3},
    "elmur": {"slots": 3, "experts": 3, "inner_width": 5},
}


def core_named(
    name: str, *, context_steps: int = 40, layers: int = 2, tokens_per_step: int = 1, **options: Any
) -> Core:
    torch.manual_seed(0)
    return make_core(
        name,
        width=WIDTH,
        layers=layers,
        heads=2,
        context_steps=context_steps,
        dropout=0.0,
        tokens_per_step=tokens_per_step,
        given={**SMALL_OPTIONS.get(name, {}), **options},
    ).eval()


def steps(n_episodes: int = 2) -> Tensor:
    return torch.randn(n_episodes, N_STEPS, WIDTH, generator=torch.Generator().manual_seed(1))


def answers(core: Core, tokens: Tensor, *, at_once: int) -> Tensor:
    memory, parts = core.begin(len(tokens)), []
    for first in range(0, tokens.shape[1], at_once):
        answer, memory = core(tokens[:, first : first + at_once], memory)
        parts.append(answer.detach())
    return torch.cat(parts, dim=1)


@pytest.mark.parametrize(("context_steps", "tokens_per_step"), [(1, 1), (3, 1), (40, 1), (2, 3)])
@pytest.mark.parametrize("name", CORES)
def test_steps_one_by_one_get_the_answers_of_all_steps_at_once(
    name: str, context_steps: int, tokens_per_step: int
) -> None:
    core = core_named(name, context_steps=context_steps, tokens_per_step=tokens_per_step)
    whole = answers(core, steps(), at_once=N_STEPS)
    for at_once in (1, 5):
        torch.testing.assert_close(answers(core, steps(), at_once=at_once), whole, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", ["gru", "lstm"])
def test_an_answer_before_a_step_knows_the_steps_before_and_not_the_step(name: str) -> None:
    core, tokens = core_named(name, answers_before=True), steps()
    whole = answers(core, tokens, at_once=N_STEPS)
    for at_once in (1, 5):
        torch.testing.assert_close(answers(core, tokens, at_once=at_once), whole, atol=1e-5, rtol=1e-5)
    tokens[:, 7, 0] += 1
    other = answers(core, tokens, at_once=N_STEPS)
    torch.testing.assert_close(other[:, :8], whole[:, :8])
    assert not torch.isclose(other[:, 8], whole[:, 8]).all()


@pytest.mark.parametrize("name", ["gru", "lstm"])
def test_with_a_large_keep_bias_the_state_stays_what_it_is(name: str) -> None:
    """torch draws weights within 1 / sqrt(8), so that 18 of them times numbers within 1 are at least -6.4.

    Of the logistic function of 10 - 6.4 the gate is at least 0.97, and a sum so low is rare.
    """
    tokens = steps().clamp(-1, 1)[:, :1]
    for bias, stays in ((10.0, True), (0.0, False)):
        core = core_named(name, layers=1, keep_bias=bias)
        begun = tuple(torch.full_like(part, 0.9) for part in core.begin(2))
        kept = core(tokens, begun)[1][-1]  # of an LSTM: its cells, to which something is added
        share = kept if name == "gru" else kept - added_by_lstm(core, tokens, begun)
        assert torch.allclose(share, begun[-1], atol=0.02) is stays


def added_by_lstm(core: Any, tokens: Tensor, begun: tuple[Tensor, ...]) -> Tensor:
    """What the input gate lets in: that which the cells are from nothing, with the same hidden state."""
    return core(tokens, (begun[0], torch.zeros_like(begun[1])))[1][1]


@pytest.mark.parametrize("name", CORES)
def test_training_gets_the_answers_of_acting(name: str) -> None:
    core, tokens = core_named(name, context_steps=3), steps()
    acting = answers(core, tokens, at_once=1)
    for module in core.modules():
        if isinstance(module, torch.nn.Dropout | torch.nn.MultiheadAttention):
            module.p = module.dropout = 0.0
    torch.testing.assert_close(answers(core.train(), tokens, at_once=N_STEPS), acting, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("n_first", range(1, N_STEPS))
@pytest.mark.parametrize(("context_steps", "tokens_per_step"), [(3, 1), (5, 1), (2, 3), (1, 3)])
def test_windows_read_at_once_leave_what_windows_read_in_turn_leave(
    context_steps: int, tokens_per_step: int, n_first: int
) -> None:
    core = core_named(
        "decision_transformer",
        context_steps=context_steps,
        tokens_per_step=tokens_per_step,
        attention_dropout=0.0,
    )
    tokens, n_first = steps(), max(n_first - n_first % tokens_per_step, tokens_per_step)
    acting = answers(core, tokens, at_once=tokens_per_step)
    first, memory = core.train()(tokens[:, :n_first], core.begin(2))
    later, _ = core(tokens[:, n_first:], memory)
    torch.testing.assert_close(torch.cat([first, later], dim=1), acting, atol=1e-5, rtol=1e-5)


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


@pytest.mark.parametrize(
    ("name", "changes", "seen"),
    [
        ("rate", {}, True),
        ("rate", {"cached_tokens": 0}, True),
        ("rate", {"memory_tokens": 0, "valve_heads": 0}, True),
        ("rate", {"cached_tokens": 0, "memory_tokens": 0, "valve_heads": 0}, False),
        ("gtrxl", {}, True),
        ("elmur", {}, True),
        ("decision_transformer", {}, False),
    ],
)
def test_a_later_segment_knows_what_is_kept_of_the_first_and_nothing_else(
    name: str, changes: dict[str, Any], seen: bool
) -> None:
    core = core_named(name, context_steps=4, **changes)
    tokens = steps()
    before = answers(core, tokens, at_once=N_STEPS)[:, -1]
    tokens[:, 0, 0] += 1  # of the first segment of three
    assert torch.equal(answers(core, tokens, at_once=N_STEPS)[:, -1], before) is not seen


@pytest.mark.parametrize("name", ["rate", "elmur"])
@pytest.mark.parametrize("carries", [True, False])
def test_later_segments_teach_what_to_write_unless_that_is_switched_off(name: str, carries: bool) -> None:
    options = {**SMALL_OPTIONS[name], "carries_gradient": carries}
    core = make_core(name, width=WIDTH, layers=1, heads=2, context_steps=4, dropout=0.0, given=options)
    tokens = steps().requires_grad_()
    answers, _ = core(tokens, core.begin(2))
    answers[:, -1].square().sum().backward()
    assert tokens.grad is not None
    assert bool(tokens.grad[:, :4].any()) is carries


@pytest.mark.parametrize(("lag", "seen"), [(2, True), (3, False)])
def test_a_decision_transformer_sees_exactly_its_last_steps(lag: int, seen: bool) -> None:
    core, tokens = core_named("decision_transformer", context_steps=3), steps()
    before = answers(core, tokens, at_once=1)[:, -1]
    tokens[:, -1 - lag, 0] += 1
    assert torch.equal(answers(core, tokens, at_once=1)[:, -1], before) is not seen


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


def test_colour_keypoints_know_the_colour_of_a_cell_and_nothing_of_its_neighbours() -> None:
    features = Keypoints(image_px=64, outputs=4, features="color_keypoints").features
    assert isinstance(features, ShapesAndColors)
    image = torch.rand(1, 3, 64, 64)
    changed = image.clone()
    changed[:, :, 8:12, 20:24] = image[:, :, 8:12, 20:24].flip(-1)  # the same mean
    changed[:, :, 40:44, 12:16] += 0.5
    differs = (features.colors(changed) - features.colors(image)).abs().amax(dim=(0, 1)) > 1e-5
    assert differs.nonzero().tolist() == [[10, 3]]  # row and column of the cell, of 16 each


@pytest.mark.parametrize("image_px", [64, 128])
@pytest.mark.parametrize("name", ENCODERS)
def test_encoders_take_the_sizes_of_images_that_are_recorded(name: str, image_px: int) -> None:
    cameras = Cameras(name, n_cameras=2, image_px=image_px, outputs=5)
    assert cameras(torch.rand(2, 3, 2, 3, image_px, image_px)).shape == (2, 3, cameras.outputs)


def test_the_encoder_of_the_baselines_has_their_size() -> None:
    """9216 inputs of the last layer for 128 pixels, as in RATE (CognitiveAISystems/RATE, commit 5aa88f0)."""
    assert Nature(image_px=128, outputs=64)[7].in_features == 9216
    cameras = Cameras("nature_stacked", n_cameras=2, image_px=128, outputs=64)
    assert (len(cameras), cameras[0][0].in_channels, cameras.outputs) == (1, 6, 64)


def test_a_spatial_softmax_has_the_values_and_gradients_of_its_formula() -> None:
    def formula(maps: Tensor, sharpness: Tensor, places: Tensor) -> Tensor:
        normalised = torch.nn.functional.instance_norm(maps, eps=LEAST_VARIANCE)
        shares = (normalised * sharpness[:, None]).softmax(dim=-1)
        strong = (shares * maps).sum(dim=-1, keepdim=True)
        return torch.cat([shares @ places, strong], dim=-1)

    draws = torch.Generator().manual_seed(4)
    maps = torch.randn(3, 4, 9, generator=draws, dtype=torch.float64) + 2
    sharpness = torch.rand(4, generator=draws, dtype=torch.float64) * 3
    places = torch.randn(9, 2, generator=draws, dtype=torch.float64)
    weights = torch.randn(3, 4, 3, generator=draws, dtype=torch.float64)
    given = [part.requires_grad_() for part in (maps, sharpness)]
    torch.testing.assert_close(spatial_softmax(*given, places), formula(*given, places))
    found, expected = (
        torch.autograd.grad((of(*given, places) * weights).sum(), given) for of in (spatial_softmax, formula)
    )
    torch.testing.assert_close(found, expected)
    assert torch.autograd.gradcheck(lambda *inputs: spatial_softmax(*inputs, places), given)


@pytest.mark.parametrize("n_frames", [FRAMES_AT_ONCE - 1, FRAMES_AT_ONCE + 1, 2 * FRAMES_AT_ONCE])
def test_images_that_are_encoded_in_parts_teach_what_each_of_them_teaches(n_frames: int) -> None:
    cameras = Cameras("nature", n_cameras=2, image_px=40, outputs=5).double()
    images = torch.rand(1, n_frames, 2, 3, 40, 40, dtype=torch.float64)
    weights = torch.rand(n_frames, cameras.outputs, dtype=torch.float64)
    (cameras(images)[0] * weights).sum().backward()
    together = [parameter.grad.clone() for parameter in cameras.parameters() if parameter.grad is not None]
    cameras.zero_grad()
    for frame in range(n_frames):
        seen = cameras(images[:, frame : frame + 1])[0]
        assert seen.shape == (1, cameras.outputs)
        (seen * weights[frame]).sum().backward()
    for one_by_one, at_once in zip(cameras.parameters(), together, strict=True):
        torch.testing.assert_close(one_by_one.grad, at_once)


def test_stacked_images_are_the_channels_of_the_first_camera_and_then_of_the_second() -> None:
    cameras = Cameras("nature_stacked", n_cameras=2, image_px=64, outputs=5)
    images = torch.rand(2, 3, 2, 3, 64, 64)  # episodes, steps, cameras
    one = torch.cat([images[1, 2, 0], images[1, 2, 1]])[None]
    torch.testing.assert_close(cameras(images)[1, 2], cameras[0](2 * one - 1)[0])


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("rate", {"memory_token": 3}, r"core 'rate'.*Did you mean 'memory_tokens'"),
        ("decision_transformer", {"cached_tokens": 3}, r"option 'cached_tokens'"),
        ("rate", {"memory_tokens": 0, "valve_heads": 2}, r"valve_heads is 2, expected 0"),
        ("gtrxl", {"inner_width": 0}, r"inner_width is 0, expected a number ≥ 1"),
        ("elmur", {"slots": 0}, r"slots is 0, expected a number ≥ 1"),
        ("decision_mamba", {"state": "many"}, r"'state': expected a whole number"),
    ],
)
def test_options_that_a_core_does_not_have_or_take_are_refused(
    name: str, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(VlaEvalError, match=message):
        make_core(name, width=8, layers=1, heads=1, context_steps=1, dropout=0.0, given=given)
