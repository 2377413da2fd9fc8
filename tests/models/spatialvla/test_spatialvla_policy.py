"""SpatialVLA as a LeRobot policy: prompt, images, cameras, grids, padding, precision, what is trained."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.stats import norm

from tests.models import tiny_prompted
from tests.models.spatialvla import spatialvla_golden as golden
from tests.models.tiny_prompted import BOTH, SPATIALVLA, section
from vla_eval.data.tables import read_columns
from vla_eval.errors import (
    RecipeError,
    SpecMismatchError,
)
from vla_eval.models.shared.images import Size, resize_bicubic
from vla_eval.models.shared.language_processors import byte_tokenizer
from vla_eval.models.spatialvla.action_grid import refitted, uniform_grid
from vla_eval.models.spatialvla.configuration_spatialvla import LinearDecaySchedulerConfig
from vla_eval.models.spatialvla.generation import to_tokens
from vla_eval.models.spatialvla.modeling_spatialvla import MikasaSpatialVLAPolicy
from vla_eval.models.spatialvla.network import finished
from vla_eval.models.spatialvla.processor_spatialvla import prompt_text
from vla_eval.models.weights.trainable import check_lora, trainable
from vla_eval.training.dataset import training_dataset


def tiny(recorded: Path, **fields: Any) -> tuple[Any, Any, Any]:
    return tiny_prompted.tiny(SPATIALVLA, recorded, **fields)


def frames(n: int = 2, chunk: int = 4) -> dict[str, Any]:
    return tiny_prompted.frames(n, chunk=chunk)


class TestPrompt:
    def test_it_is_in_small_letters_and_ends_with_a_newline(self) -> None:
        assert prompt_text(" Pick the Cup ") == "pick the cup\n"

    def test_the_beginning_of_text_is_put_there_once(self) -> None:
        mask = torch.tensor([[1, 1, 1], [1, 1, 0]], dtype=torch.bool)
        bare = finished(torch.tensor([[5, 6, 4], [5, 4, 0]]), mask, golden.SIZES)
        assert bare.ids.tolist() == [[2, 5, 6, 4], [2, 5, 4, 0]]
        assert bare.mask.sum(dim=1).tolist() == [4, 3]
        begun = finished(torch.tensor([[2, 6, 4], [2, 4, 0]]), mask, golden.SIZES)
        assert begun.ids.tolist() == [[2, 6, 4], [2, 4, 0]] and torch.equal(begun.mask, mask)

    @pytest.mark.parametrize("index", range(len(golden.config()["prompts"])))
    def test_tokens_of_the_golden_tokenizer_are_the_originals(self, index: int) -> None:
        from transformers import PreTrainedTokenizerFast

        make: Any = PreTrainedTokenizerFast
        tokenizer = make(tokenizer_file=str(golden.FOLDER / "tokenizer.json"), pad_token="<pad>")
        made = tokenizer([prompt_text(golden.config()["prompts"][index])], return_tensors="pt")
        prompts = finished(made.input_ids, made.attention_mask, golden.SIZES)
        assert torch.equal(prompts.ids, golden.prompts(index).ids)

    @pytest.mark.parametrize(("ids", "message"), [([5, 6], "end with the token 4"), ([36, 4], "from 36 on")])
    def test_tokens_of_another_tokenizer_are_refused(self, ids: list[int], message: str) -> None:
        with pytest.raises(SpecMismatchError, match=message):
            finished(torch.tensor([ids]), torch.ones(1, 2, dtype=torch.bool), golden.SIZES)

    def test_token_numbers_of_the_bytes_are_those_of_the_tokenizer(self) -> None:
        tokenizer = byte_tokenizer()
        ids, sizes = tokenizer("a\n").input_ids, section(SPATIALVLA.recipe).policy["sizes"]
        assert ids[0] == sizes["bos_token"] and ids[-1] == sizes["newline_token"]
        assert len(tokenizer) == sizes["image_token"] == sizes["first_action_token"] - 1
        assert (tokenizer.pad_token_id, tokenizer.eos_token_id) == (sizes["pad_token"], sizes["stop_token"])


class TestImages:
    @pytest.mark.parametrize(("height", "width", "edge"), [(60, 90, 56), (128, 128, 224), (50, 40, 97)])
    def test_they_are_resized_bit_for_bit_as_pil_does(self, height: int, width: int, edge: int) -> None:
        levels = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
        expected = np.asarray(Image.fromarray(levels).resize((edge, edge), Image.Resampling.BICUBIC))
        told = resize_bicubic(torch.from_numpy(levels).permute(2, 0, 1).float(), Size(edge, edge))
        assert np.array_equal(told.permute(1, 2, 0).numpy(), expected)

    def test_the_originals_are_the_same(self) -> None:
        raw = golden.values()["pre.raw_image"].permute(2, 0, 1).float()
        expected = golden.values()["pre.pixel_values"][0]
        torch.testing.assert_close(
            resize_bicubic(raw, Size(golden.SIZES.image_px, golden.SIZES.image_px)) / 255,
            expected,
            atol=1e-6,
            rtol=0,
        )

    def test_the_cameras_matrix_is_that_of_a_quarter_turn(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded, pictures=BOTH)
        inputs = policy._inputs(before(frames()))
        # 90°: the image is as wide as twice its distance; 28 px is the half of 56.
        expected = torch.tensor([[28.0, 0, 28], [0, 28, 28], [0, 0, 1]]).expand(2, 2, 3, 3)
        torch.testing.assert_close(inputs.intrinsics, expected)
        policy.config.camera_fov_rad = 2 * math.atan(0.5)  # half as wide: twice the focal length
        assert float(policy._inputs(before(frames())).intrinsics[0, 0, 0, 0]) == pytest.approx(56.0)


class TestConfiguration:
    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"prefix_attention": "causl"}, "Did you mean 'causal'"),
            ({"inference_attention": "bidirectionl"}, "Did you mean 'bidirectional'"),
            ({"action_grid": "refited"}, "Did you mean 'refitted'"),
            ({"camera_fov_rad": 90.0}, r"radians in \(0, π\)"),
            ({"pictures": []}, r"pictures is \[\], expected the fields"),
            ({"action_grid": "kept"}, "no base with a grid"),
        ],
    )
    def test_what_is_mistyped_or_missing_is_named(
        self, recorded: Path, fields: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(RecipeError, match=message):
            tiny(recorded, **fields)

    def test_a_policy_without_a_grid_is_refused(self, recorded: Path) -> None:
        config = tiny(recorded)[0].config
        config.grid = []
        with pytest.raises(RecipeError, match="there is no action grid"):
            MikasaSpatialVLAPolicy(config)
        config.grid = [list(edges) for edges in uniform_grid((4, 6, 3, 4, 4, 5)).edges]
        with pytest.raises(RecipeError, match=r"has .* bins, expected"):
            MikasaSpatialVLAPolicy(config)

    def test_the_learning_rate_rises_and_falls_in_straight_lines(self) -> None:
        optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        schedule = LinearDecaySchedulerConfig(num_warmup_steps=2).build(optimizer, 6)
        rates = []
        for _ in range(7):
            rates.append(optimizer.param_groups[0]["lr"])
            optimizer.step()
            schedule.step()
        assert rates == pytest.approx([0, 0.5, 1, 0.75, 0.5, 0.25, 0])


class TestGrid:
    def test_it_is_fitted_to_the_normalised_actions_of_all_frames(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded)
        actions = torch.from_numpy(read_columns(recorded)["action"].astype(np.float32))
        normalized = before({**frames(1), "action": actions[None], "task": ["touch"]})["action"][0]
        roll = normalized[:, 3].double()
        mu, sigma = float(roll.mean()), max(float(roll.std(correction=0)), 0.01)
        # Of four equally likely bins the middle edge is the median of what lies in [-1, 1].
        middle = norm.ppf((norm.cdf(-1, mu, sigma) + norm.cdf(1, mu, sigma)) / 2, mu, sigma)
        assert policy.grid.edges[3][2] == pytest.approx(middle, abs=1e-6)

    def test_a_base_keeps_its_grid_or_its_tokens_move_along(self, recorded: Path) -> None:
        policy, _, _ = tiny(recorded)
        config = policy.config
        base = [list(edges) for edges in uniform_grid(golden.SIZES.n_bins).edges]
        fitted = config.grid
        actions = torch.from_numpy(read_columns(recorded)["action"].astype(np.float32))
        stats = training_dataset(recorded, allow_unreplayed=True).meta.stats["action"]
        config.grid, config.action_grid = base, "kept"
        config.fit_to_actions(actions, stats)
        assert (config.grid, config.base_grid) == (base, [])
        config.action_grid = "refitted"
        config.fit_to_actions(actions, stats)
        assert (config.grid, config.base_grid) == (fitted, base)
        before = {name: value.clone() for name, value in policy.network.state_dict().items()}
        policy.begin_from_base()
        first = policy.network.sizes.first_action_token
        for name in ("spatial_embed_tokens.weight", "lm_head.weight"):
            words = first if name.startswith("lm_head") else 0
            after = policy.network.state_dict()[name]
            expected = refitted(before[name][words:], config.former_grid(), config.current_grid())
            assert torch.equal(after[words:], expected) and not torch.equal(after, before[name])
            assert torch.equal(after[:words], before[name][:words])


class TestPolicy:
    def test_the_gripper_is_open_from_a_half_on_and_executed_as_maniskill_takes_it(
        self, recorded: Path
    ) -> None:
        _, before, after = tiny(recorded)
        batch = frames(1)
        batch["action"][0, :, -1] = torch.tensor([-1.0, -0.2, 0.2, 1.0])
        assert before(batch)["action"][0, :, -1].tolist() == pytest.approx([0.0, 0.4, 0.6, 1.0])
        told = torch.zeros(1, 2, 7)
        told[0, 1, -1] = 1.0
        assert after(told)[0, :, -1].tolist() == [-1.0, 1.0]

    def test_it_trains_and_acts_and_samples_together_get_what_they_get_alone(self, recorded: Path) -> None:
        policy, before, after = tiny(recorded, pictures=BOTH)
        batch = frames()
        loss, parts = policy.train().forward(before(dict(batch)))
        loss.backward()
        assert parts["cross_entropy"] == pytest.approx(float(loss))
        head = policy.network.position_embedding_3d.position_embedding_head
        assert head[0].weight.grad.abs().sum() > 0
        together = policy.predict_action_chunk(before(dict(batch)))
        assert together.shape == (2, 4, 7) and torch.isfinite(after(together)).all()
        for index in range(2):
            one = {key: value[index : index + 1] for key, value in batch.items()}
            assert torch.equal(policy.predict_action_chunk(before(one))[0], together[index])
        # lerobot's own loop executes the first of each chunk.
        assert torch.equal(policy.select_action(before(dict(batch))), together[:, 0])

    def test_training_lowers_the_loss_until_the_actions_are_told(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded, chunk_size=1, n_action_steps=1)
        batch = before(frames(1, chunk=1))
        optimizer = torch.optim.Adam(policy.get_optim_params(), 3e-3)
        for _ in range(25):
            loss, _ = policy.train().forward(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        told, sizes = policy.predict_action_chunk(batch), policy.network.sizes
        wanted = to_tokens(batch["action"], policy.grid, sizes)
        assert torch.equal(to_tokens(told, policy.grid, sizes), wanted)


class TestTrained:
    @pytest.mark.parametrize("trains_embeddings", [False, True])
    def test_lora_is_on_eyes_places_projector_and_gemma_and_not_on_the_depth_model(
        self, recorded: Path, trains_embeddings: bool
    ) -> None:
        fields = {"train_spatial_embeddings": trains_embeddings, "train_word_embeddings": False}
        policy, _, _ = tiny(recorded, **fields)
        linear = {name for name, part in policy.named_modules() if isinstance(part, torch.nn.Linear)}
        policy.config.pretrained_path = "base"
        defaults = policy.config.lora_defaults()
        wrapped = policy.wrap_with_peft(peft_cli_overrides={"r": 4, "lora_alpha": 4})
        full = defaults["modules_to_save"] or ()
        modules = check_lora(wrapped, defaults["target_modules"], full)
        spared = ("network.depth.", "network.lm_head")
        assert set(modules) == {name for name in linear if not name.startswith(spared)}
        # The original's list of endings would have taken these.
        assert any(name.startswith("network.depth.") and name.endswith("out_proj") for name in linear)
        trained = trainable(wrapped)
        assert len([name for name in trained if "lora_" in name]) == 2 * len(modules)
        whole = {name.split("network.")[-1] for name in trained if "lora_" not in name}
        saved = "spatial_embed_tokens.modules_to_save.default.weight"
        assert whole == ({saved} if trains_embeddings else set())

    def test_without_lora_the_depth_model_and_on_demand_the_embeddings_are_left_as_they_are(
        self, recorded: Path
    ) -> None:
        names = {name for name, _ in tiny(recorded)[0].named_parameters()}
        depth = {name for name in names if name.startswith("network.depth.")}
        assert depth and set(trainable(tiny(recorded)[0])) == names - depth
        frozen = {"train_spatial_embeddings": False, "train_word_embeddings": False}
        embeddings = {
            "network.spatial_embed_tokens.weight",
            "network.llm.embed_tokens.weight",
            "network.lm_head.weight",
        }
        assert set(trainable(tiny(recorded, **frozen)[0])) == names - depth - embeddings


def test_the_recipe_is_the_originals_script() -> None:
    recipe = section("spatialvla")
    assert (recipe.steps, recipe.batch_size, recipe.base_checkpoint) == (
        50_000,
        32,
        "checkpoints/spatialvla_4b",
    )
    assert recipe.lora is not None and (recipe.lora.rank, recipe.lora.alpha) == (32, 32)
    # 0.5 % of the steps, as the original's script has it.
    assert recipe.policy["scheduler_warmup_steps"] == 0.005 * recipe.steps
