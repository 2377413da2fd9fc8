"""Our Octo gives the numbers of the original code; each trap of a port would be seen by these tests.

`tests/golden/octo/README.md` says what the stored tensors are and how close to expect them.
"""

from collections.abc import Callable, Mapping
from typing import Any, cast
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from tests.models.golden_values import GoldenValues
from tests.models.octo.octo_golden import (
    CONFIG,
    TIGHT,
    make_network,
    original_weights,
    sampling_noise,
    values,
    window,
)
from tests.models.octo.tiny_octo import our_name
from vla_eval.errors import CheckpointError
from vla_eval.models.octo import diffusion_head, transformer
from vla_eval.models.octo.diffusion_head import Draws, HeadSizes, Targets, cosine_schedule
from vla_eval.models.octo.flax_names import from_flax
from vla_eval.models.octo.transformer import OctoNetwork, Outputs, TransformerSizes, Window

GROUPS = 3e-5  # absolute, as `TIGHT`: image tokens and observation groups
WITH_LANGUAGE = [case for case in CONFIG["cases"] if case != "w2_nolang"]


@pytest.fixture(scope="module")
def io() -> GoldenValues:
    return values()


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    return original_weights()


@pytest.fixture(scope="module")
def network(weights: dict[str, Tensor]) -> OctoNetwork:
    return make_network(weights)


def furthest(found: Tensor, expected: Tensor) -> float:
    assert found.shape == expected.shape
    return float((found - expected).abs().max())


class TestForward:
    @pytest.mark.parametrize("case", CONFIG["cases"])
    @torch.no_grad()
    def test_tokens_readouts_and_noise_are_those_of_the_original(
        self, io: Mapping[str, Tensor], network: OctoNetwork, case: str
    ) -> None:
        outputs = network.transformer(window(io, case))
        assert furthest(outputs.readout_BWD, io[f"{case}.out.readout_action"]) < TIGHT
        for name, group in (("primary", "primary"), ("wrist", "wrist"), ("task_language", "language")):
            if f"{case}.out.obs_{name}" in io:
                assert furthest(outputs.groups[group], io[f"{case}.out.obs_{name}"]) < GROUPS
        real = io[f"{case}.pad_mask_language"]  # rows without an instruction are undefined in the original
        assert furthest(outputs.task_BLD[real], io[f"{case}.out.task_tokens"][real]) < TIGHT
        told = network.head(
            io[f"{case}.out.readout_action"], io[f"{case}.head.noisy_actions"], io[f"{case}.head.time"]
        )
        assert furthest(told, io[f"{case}.head.eps"]) < TIGHT

    @torch.no_grad()
    def test_image_tokens_are_those_of_the_original(
        self, io: Mapping[str, Tensor], network: OctoNetwork
    ) -> None:
        tokens = network.transformer.image_tokens(window(io, "wmax"))
        for camera in CONFIG["cameras"]:
            assert furthest(tokens[camera], io[f"mid.stem_tokens_{camera}"]) < GROUPS

    @torch.no_grad()
    def test_the_text_encoder_of_transformers_is_that_of_the_original(
        self, io: Mapping[str, Tensor], weights: dict[str, Tensor]
    ) -> None:
        from vla_eval.models.octo.language import T5Sizes, make_text_encoder

        t5 = CONFIG["t5"]
        encoder = make_text_encoder(
            T5Sizes(
                vocabulary=t5["vocab_size"],
                width=t5["d_model"],
                key=t5["d_kv"],
                heads=t5["num_heads"],
                layers=t5["num_layers"],
                mlp_width=t5["d_ff"],
                buckets=t5["relative_attention_num_buckets"],
                max_distance=t5["relative_attention_max_distance"],
            )
        )
        own = {k.removeprefix("language."): x for k, x in from_flax(weights).items() if "language." in k[:9]}
        missing = encoder.load_state_dict(own, strict=False)
        assert missing.unexpected_keys == [] and missing.missing_keys == ["encoder.embed_tokens.weight"]
        embedded = encoder(
            input_ids=io["in.language_input_ids"], attention_mask=io["in.language_attention_mask"]
        ).last_hidden_state
        assert furthest(embedded, io["mid.language_embeddings"]) < TIGHT
        # Padding of an instruction is attended to like its words: there is one mask per instruction.
        assert io["mid.language_token_mask"].all()


class TestDiffusion:
    def test_the_schedule_is_that_of_the_original(self, io: Mapping[str, Tensor]) -> None:
        schedule = cosine_schedule(CONFIG["action_head"]["diffusion_steps"])
        for name, numbers in zip(("betas", "alphas", "alpha_hats"), schedule, strict=True):
            assert furthest(numbers, io[f"schedule.{name}"]) < 1e-6

    @pytest.mark.parametrize("case", ["w1", "wmax_padhist"])
    @torch.no_grad()
    def test_sampling_from_the_same_noise_gives_the_same_chunk(
        self, io: Mapping[str, Tensor], network: OctoNetwork, case: str
    ) -> None:
        readout = io[f"{case}.out.readout_action"][:, -1]
        chunk = network.head.sample(readout, sampling_noise(io, case))
        assert furthest(chunk, io[f"sample.{case}.actions"]) < TIGHT

    @pytest.mark.parametrize(("case", "loss"), [("w1", "w1"), ("wmax_pad_wristmask",) * 2])
    def test_loss_and_gradients_are_those_of_the_original(
        self, io: Mapping[str, Tensor], network: OctoNetwork, case: str, loss: str
    ) -> None:
        network.zero_grad()
        value = loss_of(network, io, case)
        for name in ("value", "mse"):  # the same, where the loss is the squared error
            assert furthest(value.detach()[None], io[f"loss.{loss}.{name}"]) < TIGHT
        value.backward()
        gradients = {f"network.{name}": x.grad for name, x in network.named_parameters()}
        for key, norm in zip(CONFIG["gradient_norm_order"], io[f"loss.{loss}.grad_norms"], strict=True):
            found = gradients.pop(our_name(key))
            found_norm = 0.0 if found is None else float(found.norm())
            assert abs(found_norm - float(norm)) / max(float(norm), 1e-3) < 1e-4, key
        assert not gradients  # the original's list is complete
        stored = f"loss.{loss}.grad."
        for key in (key for key in io if key.startswith(stored)):
            name = our_name(key.removeprefix(stored))
            found = dict(network.named_parameters())[name.removeprefix("network.")].grad
            expected = from_flax({key.removeprefix(stored): io[key]})[name]
            assert furthest(cast(Tensor, found), expected) < TIGHT


def loss_of(network: OctoNetwork, io: Mapping[str, Tensor], case: str) -> Tensor:
    seen = window(io, case)
    outputs: Outputs = network.transformer(seen)
    return network.head.loss(
        outputs.readout_BWD,
        Targets(io[f"loss.{case}.actions"], io[f"loss.{case}.action_pad_mask"], seen.step_mask),
        Draws(io[f"loss.{case}.time"], io[f"loss.{case}.noise"]),
    )


def unbiased(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    return torch.std(self, *args, **{**kwargs, "correction": 1})


def exact_gelu(x: Tensor, approximate: str = "none") -> Tensor:
    return x * 0.5 * (1 + torch.erf(x / 2**0.5))


def readouts_are_seen(keys: Tensor, n_task: int, n_steps: int) -> Tensor:
    n = keys.shape[1]
    place = torch.arange(n) - n_task
    step = torch.where(place < 0, -1, place // ((n - n_task) // n_steps))
    return ((step[None] <= step[:, None]) & keys[:, None, :])[:, None]


def padding_is_seen(keys: Tensor, n_task: int, n_steps: int) -> Tensor:
    return REAL_MASK(torch.ones_like(keys), n_task, n_steps)


def everything_is_seen(keys: Tensor, n_task: int, n_steps: int) -> Tensor:
    return keys[:, None, None, :].expand(-1, 1, keys.shape[1], -1)


REAL_MASK = transformer.attention_mask


class TestTraps:
    """What ports get wrong moves a readout by more than the tolerance."""

    def moved(self, network: OctoNetwork, io: Mapping[str, Tensor], case: str) -> float:
        with torch.no_grad():
            readout = network.transformer(window(io, case)).readout_BWD
        return furthest(readout, io[f"{case}.out.readout_action"])

    @pytest.mark.parametrize(
        ("target", "attribute", "broken"),
        [
            (Tensor, "std", unbiased),
            (functional, "gelu", exact_gelu),
            (transformer, "attention_mask", readouts_are_seen),
            (transformer, "attention_mask", padding_is_seen),
            (transformer, "attention_mask", everything_is_seen),
            (transformer, "STANDARDIZATION_EPSILON", 1e-2),
            (transformer, "MIDDLE_LEVEL", 128.0),
        ],
        ids=["deviation", "gelu", "readouts", "padding", "causality", "epsilon", "levels"],
    )
    def test_a_broken_transformer_is_noticed(
        self, io: Mapping[str, Tensor], network: OctoNetwork, target: Any, attribute: str, broken: Any
    ) -> None:
        with patch.object(target, attribute, broken):
            assert self.moved(network, io, "wmax_pad_wristmask") > TIGHT

    @pytest.mark.parametrize(
        "change",
        [
            lambda w: w._replace(step_mask=torch.ones_like(w.step_mask)),
            lambda w: w._replace(images={k: x.flip(2) for k, x in w.images.items()}),
            lambda w: w._replace(image_mask={k: torch.ones_like(x) for k, x in w.image_mask.items()}),
        ],
        ids=["padded steps", "colours in reverse", "missing camera"],
    )
    def test_a_wrong_window_is_noticed(
        self, io: Mapping[str, Tensor], network: OctoNetwork, change: Callable[[Window], Window]
    ) -> None:
        case = "wmax_pad_wristmask"
        with torch.no_grad():
            readout = network.transformer(change(window(io, case))).readout_BWD
        assert furthest(readout, io[f"{case}.out.readout_action"]) > TIGHT

    def test_a_schedule_without_the_offset_or_noise_in_the_last_step_is_noticed(
        self, io: Mapping[str, Tensor], network: OctoNetwork
    ) -> None:
        with patch.object(diffusion_head, "SCHEDULE_OFFSET", 0.0):
            assert (
                furthest(
                    cosine_schedule(CONFIG["action_head"]["diffusion_steps"]).betas, io["schedule.betas"]
                )
                > TIGHT
            )
        noise = torch.cat([io["sample.w1.x_init"][:, None], io["sample.w1.z"].transpose(0, 1)], dim=1)[
            :, :, -1
        ]
        late = torch.cat([noise[:, :1], noise[:, 1:].roll(1, dims=1)], dim=1)
        with torch.no_grad():
            chunk = network.head.sample(io["w1.out.readout_action"][:, -1], late)
        assert furthest(chunk, io["sample.w1.actions"]) > TIGHT

    def test_a_loss_that_counts_padding_is_noticed(
        self, io: Mapping[str, Tensor], network: OctoNetwork
    ) -> None:
        case = "wmax_pad_wristmask"
        everything = {
            **io,
            f"loss.{case}.action_pad_mask": torch.ones_like(io[f"loss.{case}.action_pad_mask"]),
        }
        with torch.no_grad():
            value = loss_of(network, everything, case)
        assert furthest(value[None], io[f"loss.{case}.value"]) > TIGHT


class TestPublishedSizes:
    @pytest.mark.parametrize(
        ("fields", "n_parameters", "n_head"),
        [
            ({}, 27_042_060, 1_703_564),
            ({"width": 768, "heads": 12, "mlp_width": 3072}, 92_830_092, 1_801_868),
        ],
        ids=["small", "base"],
    )
    def test_small_and_base_have_the_published_numbers_of_parameters(
        self, fields: dict[str, int], n_parameters: int, n_head: int
    ) -> None:
        with torch.device("meta"):
            made = OctoNetwork(
                TransformerSizes(image_px={"primary": 256, "wrist": 128}, **fields),  # type: ignore[arg-type]
                HeadSizes(condition=fields.get("width", 384)),
            )
        assert sum(x.numel() for x in made.parameters()) == n_parameters
        assert sum(x.numel() for x in made.head.parameters()) == n_head


def test_a_tensor_that_this_architecture_does_not_have_is_named() -> None:
    tree = {"octo_transformer.obs_proprio_projection_2.kernel": torch.zeros(2, 2)}
    with pytest.raises(CheckpointError, match="obs_proprio_projection_2"):
        from_flax(tree)
