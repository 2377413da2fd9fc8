"""The network of OpenVLA-OFT says what the original code says, with the original's weights."""

import copy
import functools

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from tests.models.openvla import openvla_golden as golden
from tests.models.openvla.openvla_golden import TOLERANCE
from tests.models.original_names import openvla_names
from vla_eval.models.openvla.network import Inputs, OpenVLANetwork
from vla_eval.models.openvla.sizes import NetworkOptions, NetworkSizes
from vla_eval.models.openvla.weight_names import to_ours, unused
from vla_eval.models.shared.images import Size, resize_bicubic

CASES = [
    ("img1.prompt1", 1, "prompt1", False),
    ("img2.prompt1", 2, "prompt1", False),
    ("img1.prompt2.proprio", 1, "prompt2", True),
    ("img2.prompt2.proprio", 2, "prompt2", True),
]
TRAININGS = [("train.img1", 1, False), ("train.img2", 2, False), ("train.img2.proprio", 2, True)]
FIRST = Inputs(golden.images(2)[:1], golden.prompts("prompt1"))
VISIBLE = 1e-4  # tanh GELU, the least of these, moves actions by 1.5e-4 to 5e-4


def close(told: Tensor, expected: Tensor, *, atol: float = TOLERANCE) -> None:
    torch.testing.assert_close(told, expected.to(told.dtype), atol=atol, rtol=0)


@functools.cache
def made(*, proprio: bool = False) -> OpenVLANetwork:
    return golden.network(proprio=golden.PROPRIO if proprio else 0)


def gradients_by_original_name(network: OpenVLANetwork) -> dict[str, Tensor]:
    ours = {key: value.grad for key, value in network.named_parameters() if value.grad is not None}
    gradients = openvla_names(ours)
    # Weights of the class token and of its position are added up, since the original has only their sum;
    # the gradient of a sum is that of either part.
    name = "embeddings.cls_token"
    gradients["vision_backbone.featurizer.cls_token"] = ours[f"vision.dino.{name}"]
    return gradients


def proprio_of(rows: slice, *, proprio: bool) -> Tensor | None:
    return golden.values()["in.proprio"][rows] if proprio else None


def answer(network: OpenVLANetwork, n_cameras: int = 2, prompt: str = "prompt1") -> Tensor:
    with torch.no_grad():
        return network.actions(Inputs(golden.images(n_cameras)[:1], golden.prompts(prompt)))[0]


class TestInference:
    @pytest.mark.parametrize("n_cameras", [1, 2])
    def test_features_and_tokens_of_the_images(self, n_cameras: int) -> None:
        network, values = made(), golden.values()
        with torch.no_grad():
            features = network.vision(golden.images(n_cameras))
            tokens = network.projector(features)
        close(features, values[f"mid.img{n_cameras}.vision_features"])
        close(tokens, values[f"mid.img{n_cameras}.projected_patches"])

    def test_the_images_are_normalised_for_either_eye(self) -> None:
        both = made().vision.normalised(golden.images(1)[0])
        close(both.flatten(0, 2), golden.values()["mid.pixel_values_sample0_image0"][0].flatten(0, 0))

    def test_a_raw_image_is_resized_and_normalised_as_by_the_originals_processor(self) -> None:
        raw = golden.values()["pre.raw_image"].permute(2, 0, 1).float()
        edge = golden.SIZES.image_px
        pixels = made().vision.normalised(resize_bicubic(raw, Size(edge, edge))[None] / 255)
        close(pixels.flatten(0, 2), golden.values()["pre.pixel_values"])

    @pytest.mark.parametrize(("name", "n_cameras", "prompt", "proprio"), CASES)
    def test_hidden_states_and_actions(self, name: str, n_cameras: int, prompt: str, proprio: bool) -> None:
        network, values = made(proprio=proprio), golden.values()
        sample = slice(0, 1) if prompt == "prompt1" else slice(1, 2)
        with torch.no_grad():
            sequence = network.sequence(
                Inputs(
                    golden.images(n_cameras)[sample],
                    golden.prompts(prompt),
                    proprio_of(sample, proprio=proprio),
                )
            )
            hidden = network.action_states(sequence)
            actions = network.action_head(hidden)
        close(hidden, values[f"infer.{name}.hidden"])
        close(actions[0], values[f"infer.{name}.actions_normalized"])

    def test_a_batch_of_prompts_of_several_lengths_gives_each_what_it_gets_alone(self) -> None:
        network, images = made(), golden.images(2)
        rows = [[1, 512, 29901, 29871], [1, 512, 29901, 1724, 3158, 881, 29871]]
        with torch.no_grad():
            together = network.actions(Inputs(images, golden.padded(rows)))
            for index, row in enumerate(rows):
                alone = network.actions(Inputs(images[index : index + 1], golden.padded([row])))
                close(together[index : index + 1], alone, atol=5e-6)


class TestTraining:
    @pytest.mark.parametrize(("name", "n_cameras", "proprio"), TRAININGS)
    def test_loss_and_gradients_of_a_padded_batch(self, name: str, n_cameras: int, proprio: bool) -> None:
        network, values = copy.deepcopy(made(proprio=proprio)), golden.values()
        batch = Inputs(
            golden.images(n_cameras), golden.training_prompts(), proprio_of(slice(2), proprio=proprio)
        )
        hidden = network.action_states(network.sequence(batch))
        actions = network.action_head(hidden)
        loss = functional.l1_loss(actions, values["train.actions"])
        loss.backward()
        close(hidden, values[f"{name}.hidden"])
        close(actions, values[f"{name}.predicted_actions"])
        close(loss, values[f"{name}.l1_loss"][0])
        gradients = gradients_by_original_name(network)
        stored = [key for key in values if key.startswith(f"{name}.grad.")]
        assert stored
        for key in stored:
            close(gradients[key.removeprefix(f"{name}.grad.").removeprefix("vla.")], values[key])
        names = golden.config()["gradient_norm_order"][name]
        for key, norm in zip(names, values[f"{name}.grad_norms"], strict=True):
            torch.testing.assert_close(gradients[key.removeprefix("vla.")].norm(), norm, rtol=1e-4, atol=1e-6)

    def test_the_sequence_of_a_padded_batch_is_the_originals(self) -> None:
        network, values, prompts = made(), golden.values(), golden.training_prompts()
        labels, is_action = values["train.labels"], values["train.action_mask_shifted"]
        n_tokens = golden.CHUNK * golden.ACTION
        tokens = values["train.input_ids"][:, 1:][is_action].reshape(len(labels), n_tokens)
        ids, ours, is_real = network._text(prompts, tokens)
        assert torch.equal(ids, values["train.input_ids"])
        assert torch.equal(is_real, values["train.attention_mask"])
        assert torch.equal(ours[:, 1:], is_action)
        # What is learned with a token head: the actions and the stop token behind them.
        stop = ours.roll(1, dims=1) & ~ours & (ids == golden.SIZES.stop_token)
        is_learned = labels != golden.config()["tokens"]["ignore_index"]
        assert torch.equal(ours | stop, is_learned) and torch.equal(ids[is_learned], labels[is_learned])


class TestTraps:
    """What is easily got wrong without any error; each changes the actions visibly."""

    def difference(self, network: OpenVLANetwork, actions: Tensor | None = None) -> float:
        told = answer(network) if actions is None else actions
        return float((told - golden.values()["infer.img2.prompt1.actions_normalized"]).abs().max())

    @pytest.fixture
    def network(self) -> OpenVLANetwork:
        return copy.deepcopy(made())

    def test_nothing_broken_is_within_the_tolerance(self, network: OpenVLANetwork) -> None:
        assert self.difference(network) < TOLERANCE

    def test_siglips_tanh_gelu(self, network: OpenVLANetwork) -> None:
        for layer in network.vision.siglip.encoder.layers:
            layer.mlp.activation_fn = nn.GELU(approximate="tanh")
        assert self.difference(network) > VISIBLE

    @pytest.mark.parametrize("eye", ["dino", "siglip"])
    def test_a_final_norm_over_the_features(self, network: OpenVLANetwork, eye: str) -> None:
        sizes = golden.SIZES
        name = "layernorm" if eye == "dino" else "post_layernorm"
        width = sizes.dino_width if eye == "dino" else sizes.siglip_width
        setattr(getattr(network.vision, eye), name, nn.LayerNorm(width))
        assert self.difference(network) > VISIBLE

    def test_one_normalisation_for_both_eyes(self, network: OpenVLANetwork) -> None:
        network.vision.mean[1], network.vision.std[1] = network.vision.mean[0], network.vision.std[0]
        assert self.difference(network) > VISIBLE

    def test_hidden_states_of_the_action_tokens_themselves(self, network: OpenVLANetwork) -> None:
        with torch.no_grad():
            sequence = network.sequence(FIRST)
            moved = sequence._replace(first_action=sequence.first_action + 1)
            actions = network.action_head(network.action_states(moved))[0]
        assert self.difference(network, actions) > VISIBLE

    def test_causal_attention(self, network: OpenVLANetwork) -> None:
        with torch.no_grad():
            sequence = network.sequence(FIRST)
            actions = network.action_head(network.action_states(sequence, causal=True))[0]
        assert self.difference(network, actions) > VISIBLE

    def test_placeholders_that_keep_their_embedding(self, network: OpenVLANetwork) -> None:
        placeholders = torch.ones(1, network.options.n_action_tokens, dtype=torch.long)
        with torch.no_grad():
            sequence = network.sequence(FIRST, placeholders)
            actions = network.action_head(network.action_states(sequence))[0]
        assert self.difference(network, actions) > VISIBLE

    def test_a_prompt_without_the_empty_token(self, network: OpenVLANetwork) -> None:
        ids = golden.values()["in.prompt1_input_ids"][0].tolist()
        with torch.no_grad():
            actions = network.actions(Inputs(golden.images(2)[:1], golden.padded([ids])))[0]
        assert self.difference(network, actions) > VISIBLE

    def test_cameras_in_another_order(self, network: OpenVLANetwork) -> None:
        with torch.no_grad():
            actions = network.actions(FIRST._replace(images=FIRST.images.flip(1)))[0]
        assert self.difference(network, actions) > VISIBLE

    def test_padding_that_is_attended_to(self, network: OpenVLANetwork) -> None:
        prompts = golden.training_prompts()
        with torch.no_grad():
            right = network.sequence(Inputs(golden.images(2), prompts))
            wrong = right._replace(mask=torch.ones_like(right.mask))
            difference = (network.action_states(right) - network.action_states(wrong)).abs().amax(dim=(1, 2))
        assert difference[0] < TOLERANCE and difference[1] > VISIBLE  # the second row is the shorter one


class TestWeightNames:
    def test_there_and_back_is_the_same_but_for_what_is_never_used(self) -> None:
        weights = golden.original_weights()
        back = openvla_names(to_ours(weights, golden.SIZES))
        assert set(back) == {name for name in weights if not unused(name, golden.SIZES)}
        for name, tensor in back.items():
            assert torch.equal(tensor, weights[name]), name

    def test_what_is_left_out_is_the_last_blocks_the_norms_and_the_pooling(self) -> None:
        left_out = {name for name in golden.original_weights() if unused(name, golden.SIZES)}
        assert {name.split("featurizer.")[1].split(".")[0] for name in left_out} == {
            "blocks",
            "norm",
            "attn_pool",
        }
        dino, siglip = (golden.SIZES.dino_depth - 1, golden.SIZES.siglip_depth - 1)
        last = (f".featurizer.blocks.{dino}.", f".fused_featurizer.blocks.{siglip}.")
        assert all(any(part in name for part in last) for name in left_out if "blocks" in name)


@pytest.mark.slow
def test_the_published_size_has_the_published_parameters_but_for_what_is_never_used() -> None:
    with torch.device("meta"):
        network = OpenVLANetwork(NetworkSizes(), NetworkOptions())
    found = [
        sum(parameter.numel() for parameter in part.parameters())
        for part in (network.vision.dino, network.vision.siglip, network.projector, network.llm)
    ]
    # Blocks: four square matrices, two of the MLP, biases, two norms, in DINOv2 two scales.
    dino = 4 * (1024**2 + 1024) + (1024 + 1) * 4096 + (4096 + 1) * 1024 + 6 * 1024
    siglip = 4 * (1152**2 + 1152) + (1152 + 1) * 4304 + (4304 + 1) * 1152 + 4 * 1152
    llama = 4 * 4096**2 + 3 * 4096 * 11008 + 2 * 4096
    patch = 3 * 14 * 14 + 1
    assert found == [
        # class token, 4 registers, 257 positions (the class token's row is zero)
        23 * dino + patch * 1024 + (1 + 4 + 257) * 1024,
        26 * siglip + patch * 1152 + 256 * 1152,
        (2176 + 1) * 8704 + (8704 + 1) * 4096 + (4096 + 1) * 4096,
        32 * llama + 2 * 32064 * 4096 + 4096,
    ]
