"""OpenVLA as a LeRobot policy: prompt, pictures, padding, precision, and what LoRA trains."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.unit import openvla_golden as golden
from vla_eval.config.files import load_recipe
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import (
    MissingInstructionError,
    RecipeError,
    SpecMismatchError,
    TrainingError,
    UnknownNameError,
)
from vla_eval.policies.openvla.modeling_openvla import MikasaOpenVLAPolicy
from vla_eval.policies.openvla.processor_openvla import make_mikasa_openvla_pre_post_processors
from vla_eval.policies.openvla.prompt import BYTE_SIZES, finished, prompt_text
from vla_eval.policies.openvla.sizes import network_sizes
from vla_eval.policies.steps.byte_tokenizer import byte_tokenizer
from vla_eval.policies.steps.normalization import Normalization, Normalizer
from vla_eval.policies.steps.trainable import check_lora, trainable
from vla_eval.training.dataset import training_dataset
from vla_eval.training.policy_config import policy_config

BASE, WRIST = "observation.images.base", "observation.images.wrist"


def tiny_section(**fields: Any) -> dict[str, Any]:
    section = load_recipe("policies", "openvla_oft_tiny", PolicyRecipe).value.finetune
    assert section is not None
    return {**section.policy, **fields}


def tiny(recorded: Path, **fields: Any) -> tuple[Any, Any, Any]:
    """Return policy, preprocessor and postprocessor of a tiny model with the dataset's statistics."""
    torch.manual_seed(0)
    dataset = training_dataset(recorded, allow_unreplayed=True)
    recipe = FinetuneRecipe(type="mikasa_openvla", policy=tiny_section(**fields))
    config = policy_config(recipe, dataset, device="cpu")
    processors = make_mikasa_openvla_pre_post_processors(config, dataset.meta.stats)
    return MikasaOpenVLAPolicy(config), *processors


def frames(n: int = 2, chunk: int = 8) -> dict[str, Any]:
    draws = torch.Generator().manual_seed(1)
    return {
        BASE: torch.rand(n, 3, 128, 128, generator=draws),
        WRIST: torch.rand(n, 3, 128, 128, generator=draws),
        "observation.state": torch.rand(n, 10, generator=draws),
        "action": torch.rand(n, chunk, 7, generator=draws) * 0.2,
        "action_is_pad": torch.zeros(n, chunk, dtype=torch.bool),
        "task": ["Touch it", "Remember the color of the cube"][:n],
    }


class TestPrompt:
    def test_words_and_case_are_the_originals(self) -> None:
        expected = "In: What action should the robot take to pick the cup?\nOut:"
        assert prompt_text(" Pick the Cup ") == expected

    @pytest.mark.parametrize("instruction", ["", "  "])
    def test_an_empty_instruction_is_an_error(self, instruction: str) -> None:
        with pytest.raises(MissingInstructionError, match="empty"):
            prompt_text(instruction)

    def test_the_empty_token_is_put_at_each_prompts_own_end_where_it_is_missing(self) -> None:
        ids = torch.tensor([[1, 5, 6, 29871], [1, 5, 32000, 32000], [1, 5, 6, 7]])
        mask = torch.tensor([[1, 1, 1, 1], [1, 1, 0, 0], [1, 1, 1, 1]], dtype=torch.bool)
        prompts = finished(ids, mask, golden.SIZES)
        rows = [row[keep].tolist() for row, keep in zip(prompts.ids, prompts.mask, strict=True)]
        assert rows == [[1, 5, 6, 29871], [1, 5, 29871], [1, 5, 6, 7, 29871]]

    def test_a_tokenizer_that_does_not_begin_the_text_is_refused(self) -> None:
        with pytest.raises(SpecMismatchError, match="begin with the token 1"):
            finished(torch.tensor([[5, 6]]), torch.ones(1, 2, dtype=torch.bool), golden.SIZES)

    def test_token_numbers_of_the_bytes_are_those_of_the_tokenizer(self) -> None:
        tokenizer = byte_tokenizer()
        ids = tokenizer("a ").input_ids
        assert ids[0] == BYTE_SIZES["bos_token"] == tokenizer.bos_token_id
        assert ids[-1] == BYTE_SIZES["empty_token"] and len(ids) == 3
        assert tokenizer.pad_token_id == BYTE_SIZES["pad_token"]
        assert tokenizer.eos_token_id == BYTE_SIZES["stop_token"]
        # Words are below the 256 numbers that tell actions.
        assert len(tokenizer) == 3 + 256 <= BYTE_SIZES["text_vocabulary"] - 256


class TestConfiguration:
    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"head": "l2"}, "Did you mean 'l1'"),
            ({"dtype": "bfloat"}, "Did you mean 'bfloat16'"),
            ({"n_action_steps": 9}, r"expected 1 to chunk_size \(8\)"),
            ({"sizes": {"lm_width": 64}}, "Did you mean 'llm_width'"),
        ],
    )
    def test_what_is_mistyped_is_named(self, recorded: Path, fields: dict[str, Any], message: str) -> None:
        with pytest.raises(RecipeError, match=message):
            tiny(recorded, **fields)

    def test_a_mistyped_picture_is_named(self, recorded: Path) -> None:
        with pytest.raises(UnknownNameError, match=r"Did you mean 'observation\.images\.base'"):
            tiny(recorded, pictures=["observation.images.bas"])

    def test_the_published_sizes_are_the_default(self) -> None:
        sizes = network_sizes({})
        assert (sizes.n_patches, sizes.vision_width, sizes.llm_width) == (256, 2176, 4096)


class TestNormalization:
    def test_actions_and_state_are_normalised_as_in_the_originals_training(self) -> None:
        values = golden.values()
        actions = {name: values[f"data.norm.{name}"] for name in ("q01", "q99", "min", "max")}
        mask = tuple(values["data.norm.mask"].tolist())
        # The original's extremes, of actions; all of the state varies.
        assert bool((actions["min"] == actions["max"]).any())
        proprio = {name: values[f"data.norm.proprio_{name}"] for name in ("q01", "q99")}
        for name, statistics, kept in (
            ("actions", actions, mask),
            ("proprio", proprio, (True,) * golden.PROPRIO),
        ):
            spec = Normalization(kind="q01_q99", mask=kept, clip=True)
            found = Normalizer(spec, statistics, where="golden").normalize(values[f"data.norm.{name}"])
            expected = values["data.norm.normalised" if name == "actions" else "data.norm.proprio_normalised"]
            torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


class TestPolicy:
    def test_targets_are_in_quantiles_and_the_gripper_is_as_it_was(self, recorded: Path) -> None:
        _, before, after = tiny(recorded)
        batch = frames()
        encoded = before(dict(batch))
        stats = training_dataset(recorded, allow_unreplayed=True).meta.stats["action"]
        q01, q99 = (torch.as_tensor(stats[name], dtype=torch.float32) for name in ("q01", "q99"))
        expected = (2 * (batch["action"] - q01) / (q99 - q01 + 1e-8) - 1).clamp(-1, 1)
        varies = (q99 - q01)[:6] > 1e-6
        torch.testing.assert_close(
            encoded["action"][..., :6][..., varies], expected[..., :6][..., varies], atol=1e-5, rtol=1e-5
        )
        assert torch.equal(encoded["action"][..., 6], batch["action"][..., 6])
        back = after(torch.zeros(2, 8, 7))
        torch.testing.assert_close(back[0, 0, :6], ((q01 + q99) / 2)[:6], atol=1e-6, rtol=1e-5)

    def test_samples_together_get_what_they_get_alone(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded)
        batch = frames()
        together = policy.predict_action_chunk(before(dict(batch)))
        for index in range(2):
            one = {key: value[index : index + 1] for key, value in batch.items()}
            alone = policy.predict_action_chunk(before(one))
            torch.testing.assert_close(together[index : index + 1], alone, atol=1e-5, rtol=1e-5)

    def test_training_pictures_are_changed_and_those_of_an_evaluation_are_cropped(
        self, recorded: Path
    ) -> None:
        policy, _, _ = tiny(recorded)
        batch = frames()
        batch[BASE] = torch.zeros(2, 3, 128, 128)
        batch[BASE][..., 64:] = 1.0
        cropped = policy._pictures(batch, changed=False)
        assert torch.equal(cropped, policy._pictures(batch, changed=False))
        assert not torch.equal(policy._pictures(batch, changed=True), policy._pictures(batch, changed=True))
        policy.config.image_augmentation = False
        whole = policy._pictures(batch, changed=True)
        assert torch.equal(whole, policy._pictures(batch, changed=False))
        assert not torch.equal(whole, cropped)

    def test_one_picture_is_read_if_one_is_named(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded, pictures=[WRIST])
        batch = frames()
        first = policy.predict_action_chunk(before(dict(batch)))
        batch[BASE] = 1 - batch[BASE]
        assert torch.equal(policy.predict_action_chunk(before(dict(batch))), first)

    def test_a_missing_picture_is_an_error(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded)
        batch = before(frames())
        del batch[WRIST]
        with pytest.raises(SpecMismatchError, match=r"no picture 'observation\.images\.wrist'"):
            policy.predict_action_chunk(batch)

    def test_padded_actions_are_refused_or_on_demand_left_out(self, recorded: Path) -> None:
        policy, before, _ = tiny(recorded)
        batch = before(frames())
        batch["action_is_pad"][0, -2:] = True
        with pytest.raises(TrainingError, match="beyond its episode's end"):
            policy.forward(batch)
        policy.config.do_mask_loss_for_padding = True
        policy.eval()
        loss, _ = policy.forward(batch)
        batch["action"][0, -2:] = 5.0
        changed, _ = policy.forward(batch)
        torch.testing.assert_close(changed, loss)

    @pytest.mark.parametrize("head", ["l1", "parallel_tokens", "tokens"])
    def test_every_head_trains_and_acts(self, recorded: Path, head: str) -> None:
        policy, before, _ = tiny(recorded, head=head, use_proprio=True, chunk_size=2, n_action_steps=1)
        batch = before(frames(chunk=2))
        loss, _ = policy.train().forward(batch)
        loss.backward()
        assert policy.network.proprio_projector.fc1.weight.grad.abs().sum() > 0
        chunk = policy.predict_action_chunk(batch)
        assert chunk.shape == (2, 2, 7) and torch.isfinite(chunk).all()
        # lerobot's own loop executes the first of each chunk.
        torch.testing.assert_close(policy.select_action(batch), chunk[:, 0])

    def test_bfloat16_with_recomputed_activations_has_the_same_gradients_nearly(self, recorded: Path) -> None:
        losses, norms = [], []
        weights = {key: value.clone() for key, value in tiny(recorded)[0].state_dict().items()}
        for fields in ({"dtype": "float32"}, {"dtype": "bfloat16", "gradient_checkpointing": True}):
            policy, before, _ = tiny(recorded, image_augmentation=False, **fields)
            policy.load_state_dict(weights)
            assert policy.network.action_head.model.fc1.weight.dtype == torch.float32
            loss, _ = policy.train().forward(before(frames()))
            loss.backward()
            losses.append(loss.item())
            norms.append(policy.network.llm.model.layers[0].mlp.up_proj.weight.grad.float().norm().item())
        assert losses[1] == pytest.approx(losses[0], rel=0.02)
        assert norms[1] == pytest.approx(norms[0], rel=0.1)


class TestLora:
    def test_adapters_are_on_eyes_projector_and_llama_and_the_head_is_trained_whole(
        self, recorded: Path
    ) -> None:
        policy, _, _ = tiny(recorded, use_proprio=True)
        policy.config.pretrained_path = "base"
        defaults = policy.config.lora_defaults()
        wrapped = policy.wrap_with_peft(peft_cli_overrides={"r": 4, "lora_alpha": 2})
        modules = check_lora(wrapped, defaults["target_modules"], defaults["modules_to_save"])
        linear = {
            name
            for name, module in tiny(recorded, use_proprio=True)[0].named_modules()
            if isinstance(module, torch.nn.Linear)
        }
        spared = {name for name in linear if "lm_head" in name or "action_head" in name or "proprio" in name}
        assert set(modules) == linear - spared
        trained = trainable(wrapped)
        whole = {name.split("modules_to_save.default.")[-1] for name in trained if "lora_" not in name}
        expected = {
            name
            for part in ("action_head", "proprio_projector")
            for name, _ in getattr(tiny(recorded, use_proprio=True)[0].network, part).named_parameters()
        }
        assert whole == expected
        assert len([name for name in trained if "lora_" in name]) == 2 * len(modules)
