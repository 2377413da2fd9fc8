"""The network of SpatialVLA says what the original code says, with the original's weights."""

import copy
import functools

import pytest
import torch
from torch import Tensor, nn

from tests.models.original_names import spatialvla_names
from tests.models.spatialvla import spatialvla_golden as golden
from tests.models.spatialvla.spatialvla_golden import CHUNK, ELSEWHERE, LOGITS, ROOT_OF_WIDTH, SIZES
from vla_eval.models.spatialvla.conversion import to_ours
from vla_eval.models.spatialvla.depth import cut_depth, shown_images
from vla_eval.models.spatialvla.ego3d import frequencies, patch_points
from vla_eval.models.spatialvla.generation import generated_actions, generated_tokens, to_tokens, token_loss
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork
from vla_eval.models.spatialvla.sizes import TOKENS_PER_ACTION, Attention, NetworkSizes

N_PROMPTS = len(golden.config()["prompts"])
ALL = [[index] for index in range(len(golden.values()["in.images"]))]
TRAININGS: list[tuple[str, list[list[int]]]] = [("train.img1", [[0], [1]]), ("train.img2", [[0, 1]])]
REGIMES: list[tuple[str, Attention]] = [
    ("causal", "causal"),
    ("prefix_bidirectional", "bidirectional_with_padding"),
]
DEPTH_PX: int = golden.config()["ego3d"]["depth_input_size"]
VISIBLE = 2e-3  # of logits up to about 2; the least of the traps moves them by more


def close(told: Tensor, expected: Tensor, *, atol: float = ELSEWHERE) -> None:
    torch.testing.assert_close(told, expected.to(told.dtype), atol=atol, rtol=0)


@functools.cache
def made() -> SpatialVLANetwork:
    return golden.network()


def prefill(network: SpatialVLANetwork, inputs: Inputs, attention: Attention = "bidirectional") -> Tensor:
    with torch.no_grad():
        return network.logits(network.hidden(network.sequence(inputs), attention))


def one(index: int = 0) -> Inputs:
    return golden.inputs([[index % len(ALL)]], golden.prompts(index))


def close_in_unit_of_data(normalized: Tensor, expected: Tensor) -> None:
    """Compare actions with the original's, which are no longer normalised; the gripper never was."""
    (statistics,) = golden.config()["statistics"].values()
    q01, q99 = (torch.tensor(statistics["action"][name][:-1]) for name in ("q01", "q99"))
    close((normalized[:, :-1] + 1) / 2 * (q99 - q01) + q01, expected[:, :-1])
    close(normalized[:, -1], expected[:, -1])


class TestVision:
    def test_the_depth_model_is_shown_padded_images(self) -> None:
        shown = shown_images(golden.inputs(ALL, golden.prompts(0)).images[:2, 0], DEPTH_PX)
        close(shown[..., ::16, ::16], golden.values()["vision.depth_network_input_strided16"])

    @pytest.mark.parametrize("camera", ["default", "mikasa"])
    def test_points_in_space_position_encoding_and_features(self, camera: str) -> None:
        network, values = made(), golden.values()
        matrix = golden.camera(camera)
        close(matrix, values[f"pre.intrinsic_{camera}"])
        inputs = golden.inputs(ALL, golden.prompts(0), matrix)
        assert inputs.depth is not None
        depth, matrices = cut_depth(inputs.depth[:, 0], SIZES.image_px), inputs.intrinsics[:, 0]
        points = patch_points(depth, matrices, network.sizes)
        close(points, values[f"vision.{camera}.points_xyz"])
        with torch.no_grad():
            close(network.position_embedding_3d(depth, matrices), values[f"vision.{camera}.ego3d_embedding"])
            # The original divides by the root of Gemma's width what Gemma multiplies by it.
            close(
                network.image_features(inputs) / ROOT_OF_WIDTH,
                values[f"vision.{camera}.image_features_divided"],
            )
        if camera == "mikasa":
            close(frequencies(points[:1]), values["vision.frequency_encoding"])

    def test_every_image_has_a_camera_of_its_own(self) -> None:
        matrices = golden.values()["vision.per_sample_intrinsic.K"][:, None]
        with torch.no_grad():
            features = made().image_features(golden.inputs(ALL, golden.prompts(0), matrices))
        close(features / ROOT_OF_WIDTH, golden.values()["vision.per_sample_intrinsic.image_features_divided"])

    def test_siglips_last_state(self) -> None:
        images = golden.inputs(ALL, golden.prompts(0)).images[:, 0]
        with torch.no_grad():
            seen = made().vision((images - 0.5) / 0.5).last_hidden_state
        close(seen, golden.values()["vision.siglip_last_hidden"])


class TestInference:
    @pytest.mark.parametrize("index", range(N_PROMPTS))
    def test_logits_tokens_and_actions(self, index: int) -> None:
        values, inputs = golden.values(), one(index)
        assert int(values[f"infer{index}.image_index"]) == index % len(ALL)
        logits = prefill(made(), inputs)
        close(logits[:, -1:], values[f"infer{index}.prefill_logits"], atol=LOGITS)
        if index == 0:  # stored for this one alone
            close(logits, values["infer0.prefill_logits_all"], atol=LOGITS)
        with torch.no_grad():
            told = generated_tokens(made(), inputs, chunk=CHUNK, attention="bidirectional")
            actions = generated_actions(made(), golden.grid(), inputs, chunk=CHUNK, attention="bidirectional")
        assert torch.equal(told.tokens, values[f"infer{index}.generated_ids"])
        close(told.logits, values[f"infer{index}.step_logits"], atol=LOGITS)
        close_in_unit_of_data(actions[0], values[f"infer{index}.actions"])

    def test_two_images(self) -> None:
        inputs, values = golden.inputs([[0, 1]], golden.prompts(1)), golden.values()
        ids = values["infer_img2.input_ids"][0]
        n_patches = 2 * SIZES.n_patches  # of the one image, then of the other, before the prompt
        assert bool((ids[:n_patches] == SIZES.image_token).all())
        assert torch.equal(ids[n_patches:], inputs.prompts.ids[0])
        with torch.no_grad():
            told = generated_tokens(made(), inputs, chunk=CHUNK, attention="bidirectional")
            actions = generated_actions(made(), golden.grid(), inputs, chunk=CHUNK, attention="bidirectional")
        assert torch.equal(told.tokens, values["infer_img2.generated_ids"])
        close_in_unit_of_data(actions[0], values["infer_img2.actions"])
        close(told.logits, values["infer_img2.step_logits"], atol=LOGITS)

    @pytest.mark.parametrize("attention", ["causal", "bidirectional", "bidirectional_with_padding"])
    def test_a_batch_of_prompts_of_several_lengths_gives_each_what_it_gets_alone(
        self, attention: Attention
    ) -> None:
        together = golden.inputs(ALL, golden.prompts(*range(len(ALL))))
        with torch.no_grad():
            told = generated_tokens(made(), together, chunk=CHUNK, attention=attention)
            for index in range(len(ALL)):
                alone = generated_tokens(made(), one(index), chunk=CHUNK, attention=attention)
                assert torch.equal(told.tokens[index], alone.tokens[0])
                close(told.logits[index], alone.logits[0], atol=LOGITS)

    def test_each_token_is_what_a_pass_without_a_cache_tells(self) -> None:
        told = golden.values()["infer1.generated_ids"]
        with torch.no_grad():
            sequence = made().sequence(one(1), told)
            logits = made().logits(made().hidden(sequence, "bidirectional"))[0]
        first = int(sequence.first_action)
        assert torch.equal(logits[first - 1 : first + TOKENS_PER_ACTION * CHUNK - 1].argmax(dim=-1), told[0])


class TestTraining:
    @pytest.mark.parametrize(("name", "images"), TRAININGS)
    @pytest.mark.parametrize(("regime", "attention"), REGIMES)
    def test_logits_loss_and_gradients_of_a_padded_batch(
        self, name: str, images: list[list[int]], regime: str, attention: Attention
    ) -> None:
        network, values = copy.deepcopy(made()), golden.values()
        inputs = golden.inputs(images, golden.training_prompts(name))
        actions = values["in.actions"][: len(images)]
        ids = to_tokens(actions, golden.grid(), network.sizes).flatten(1)
        close(
            inputs.intrinsics, values[f"{name}.intrinsic"].reshape(-1, 1, 3, 3).expand_as(inputs.intrinsics)
        )
        sequence = network.sequence(inputs, ids)
        logits = network.logits(network.hidden(sequence, attention))
        places = torch.arange(logits.shape[1])
        is_told = (places >= sequence.first_action[:, None]) & (places < sequence.lengths[:, None])
        assert torch.equal(is_told, values[f"{name}.token_type_ids"].bool())
        is_real = values[f"{name}.attention_mask"].bool()
        compared = is_real if attention == "causal" else torch.ones_like(is_real)
        expected = values[f"{name}.{regime}.logits"]
        close(logits[compared], expected[compared], atol=LOGITS)
        loss = token_loss(network, golden.grid(), inputs, actions, torch.ones(len(images), CHUNK), attention)
        loss.backward()
        close(loss, values[f"{name}.{regime}.loss"][0])
        gradients = spatialvla_names(
            {key: value.grad for key, value in network.named_parameters() if value.grad is not None}
        )
        names = golden.config()["gradient_norm_order"][f"{name}.{regime}"]
        for key, norm in zip(names, values[f"{name}.{regime}.grad_norms"], strict=True):
            if f"{name}.{regime}.grad.{key}" in values:
                close(gradients[key], values[f"{name}.{regime}.grad.{key}"])
            if key.endswith("k_proj.bias"):
                # A key's bias adds the same to all scores of a query, which softmax does not see: its
                # gradient is 0, and what is found is the rounding of float32 sums, another on each CPU.
                rounding = 1e-6 * gradients[key.replace("bias", "weight")].norm()
                assert max(gradients[key].norm(), norm) < rounding, key
                continue
            torch.testing.assert_close(gradients[key].norm(), norm, rtol=1e-4, atol=1e-7, msg=key)

    def test_a_sample_counts_the_same_whatever_is_beside_it_unless_padding_is_seen(self) -> None:
        actions = golden.values()["in.actions"][:2]
        both = golden.inputs([[0], [1]], golden.training_prompts("train.img1"))
        short = both.prompts.ids[1, both.prompts.mask[1]].tolist()
        alone = golden.inputs([[1]], golden.padded([short]))
        only_second = torch.tensor([[0.0], [1.0]]).expand(-1, CHUNK)

        def difference(attention: Attention) -> float:
            with torch.no_grad():
                beside = token_loss(made(), golden.grid(), both, actions, only_second, attention)
                by_itself = token_loss(
                    made(), golden.grid(), alone, actions[1:], torch.ones(1, CHUNK), attention
                )
            return float((beside - by_itself).abs())

        assert max(difference("causal"), difference("bidirectional")) < 2e-6
        assert difference("bidirectional_with_padding") > 1e-4

    def test_actions_that_are_left_out_change_nothing(self) -> None:
        actions, inputs = golden.values()["in.actions"][:1].clone(), one()
        counts = torch.tensor([[1.0, 1.0, 0.0, 0.0]])
        with torch.no_grad():
            losses = []
            for value in (0.5, -0.9):
                actions[:, 2:] = value
                losses.append(token_loss(made(), golden.grid(), inputs, actions, counts, "causal"))
        close(losses[0], losses[1], atol=1e-6)


class TestTraps:
    """What is easily got wrong without any error; each changes the logits visibly."""

    @pytest.fixture
    def network(self) -> SpatialVLANetwork:
        return copy.deepcopy(made())

    def difference(
        self, network: SpatialVLANetwork, inputs: Inputs | None = None, **kwargs: Attention
    ) -> float:
        told = prefill(network, inputs or one(), **kwargs)
        return float((told - golden.values()["infer0.prefill_logits_all"]).abs().max())

    def test_nothing_broken_is_within_the_tolerance(self, network: SpatialVLANetwork) -> None:
        assert self.difference(network) < LOGITS

    def test_patches_divided_by_the_root_of_gemmas_width(self, network: SpatialVLANetwork) -> None:
        features = network.image_features
        network.image_features = lambda inputs: features(inputs) / ROOT_OF_WIDTH  # type: ignore[method-assign]
        assert self.difference(network) > VISIBLE

    def test_action_tokens_not_multiplied_by_the_root_of_gemmas_width(
        self, network: SpatialVLANetwork
    ) -> None:
        ids = golden.values()["infer0.generated_ids"]
        right = golden.values()["infer0.step_logits"][:, -1]
        with torch.no_grad():
            for factor, is_right in ((1.0, True), (1 / ROOT_OF_WIDTH, False)):
                network.spatial_embed_tokens.weight.mul_(factor)
                sequence = network.sequence(one(), ids)
                last = network.hidden(sequence, "bidirectional")[
                    :, int(sequence.first_action) + TOKENS_PER_ACTION * CHUNK - 2
                ]
                difference = float((network.logits(last) - right).abs().max())
                assert (difference < LOGITS) == is_right and (difference > VISIBLE) != is_right

    def test_words_matrix_for_action_tokens(self, network: SpatialVLANetwork) -> None:
        ids = golden.values()["infer0.generated_ids"][:, :1]
        assert not torch.allclose(network.embed(ids), network.llm.embed_tokens(ids), atol=0.1)

    def test_siglips_exact_gelu(self, network: SpatialVLANetwork) -> None:
        for layer in network.vision.encoder.layers:
            layer.mlp.activation_fn = nn.GELU()
        with torch.no_grad():
            seen = network.vision((one().images[:, 0] - 0.5) / 0.5).last_hidden_state
        assert float((seen - golden.values()["vision.siglip_last_hidden"][:1]).abs().max()) > 5 * ELSEWHERE

    def test_attention_that_leaves_out_its_cap(self, network: SpatialVLANetwork) -> None:
        # torch's own kernel does: weights that make attention sharp show it.
        for layer in network.llm.layers:
            layer.self_attn.q_proj.weight.data.mul_(30)
        capped = prefill(network, one())
        network.llm.config._attn_implementation = "sdpa"
        assert float((prefill(network, one()) - capped).abs().max()) > VISIBLE

    def test_causal_attention(self, network: SpatialVLANetwork) -> None:
        assert self.difference(network, attention="causal") > VISIBLE

    def test_images_that_siglip_sees_unnormalised(self, network: SpatialVLANetwork) -> None:
        brighter = one()._replace(images=one().images * 0.5 + 0.5)
        assert self.difference(network, brighter) > VISIBLE

    def test_another_cameras_matrix(self, network: SpatialVLANetwork) -> None:
        inputs = golden.inputs([[0]], golden.prompts(0), golden.camera("default"))
        assert self.difference(network, inputs) > VISIBLE / 4

    def test_depth_that_is_not_cut_back(self, network: SpatialVLANetwork) -> None:
        whole = torch.nn.functional.interpolate(
            golden.values()["in.predicted_depth"][:1, None], (SIZES.image_px,) * 2
        )
        cut = cut_depth(golden.values()["in.predicted_depth"][:1], SIZES.image_px)
        assert float((whole[:, 0] - cut).abs().mean()) > 0.1

    def test_a_prompt_without_its_newline(self, network: SpatialVLANetwork) -> None:
        ids = golden.prompts(0).ids[:, :-1]
        inputs = golden.inputs([[0]], golden.padded(ids.tolist()))
        told = prefill(network, inputs)[:, -1]
        assert float((told - golden.values()["infer0.prefill_logits"][:, 0]).abs().max()) > VISIBLE

    def test_cameras_in_another_order(self, network: SpatialVLANetwork) -> None:
        inputs = golden.inputs([[1, 0]], golden.prompts(1))
        with torch.no_grad():
            told = generated_tokens(network, inputs, chunk=1, attention="bidirectional").logits[:, 0]
        assert float((told - golden.values()["infer_img2.step_logits"][:, 0]).abs().max()) > VISIBLE


def test_names_of_weights_there_and_back_are_the_same() -> None:
    weights = golden.original_weights()
    assert set(spatialvla_names(to_ours(weights))) == set(weights)
    zoe = "vision_zoe_model.backbone.embeddings.cls_token"
    assert list(to_ours({zoe: torch.zeros(1)})) == ["depth.zoe.backbone.embeddings.cls_token"]


@pytest.mark.slow
def test_the_published_size_has_the_published_parameters() -> None:
    with torch.device("meta"):
        network = SpatialVLANetwork(NetworkSizes())
    assert sum(parameter.numel() for parameter in network.parameters()) == 4_027_854_731
