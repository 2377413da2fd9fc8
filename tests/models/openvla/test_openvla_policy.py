"""OpenVLA as a LeRobot policy: prompt, images, padding, precision, and what LoRA trains."""

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models import tiny_prompted
from tests.models.openvla import openvla_golden as golden
from tests.models.tiny_prompted import BASE, OPENVLA, section
from vla_eval.errors import (
    RecipeError,
    SpecMismatchError,
)
from vla_eval.models.openvla.network import finished
from vla_eval.models.openvla.processor_openvla import prompt_text
from vla_eval.models.openvla.sizes import NetworkSizes
from vla_eval.models.shared.language_processors import byte_tokenizer
from vla_eval.models.shared.network_sizes import with_changes
from vla_eval.models.shared.normalization import Normalization, Normalizer
from vla_eval.models.weights.trainable import check_lora, trainable
from vla_eval.training.dataset import training_dataset


def tiny(recorded: Path, **fields: Any) -> tuple[Any, Any, Any]:
    return tiny_prompted.tiny(OPENVLA, recorded, **fields)


def frames(n: int = 2, chunk: int = 8) -> dict[str, Any]:
    return tiny_prompted.frames(n, chunk=chunk)


class TestPrompt:
    def test_words_and_case_are_the_originals(self) -> None:
        expected = "In: What action should the robot take to pick the cup?\nOut:"
        assert prompt_text(" Pick the Cup ") == expected

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
        ids, sizes = tokenizer("a ").input_ids, section(OPENVLA.recipe).policy["sizes"]
        assert ids[0] == sizes["bos_token"] == tokenizer.bos_token_id
        assert ids[-1] == sizes["empty_token"] and len(ids) == 3
        assert tokenizer.pad_token_id == sizes["pad_token"]
        assert tokenizer.eos_token_id == sizes["stop_token"]
        # Words are below the 256 numbers that tell actions.
        assert len(tokenizer) == 3 + 256 <= sizes["text_vocabulary"] - 256


class TestConfiguration:
    def test_a_mistyped_head_is_named(self, recorded: Path) -> None:
        with pytest.raises(RecipeError, match="Did you mean 'l1'"):
            tiny(recorded, head="l2")

    def test_the_published_sizes_are_the_default(self) -> None:
        sizes = with_changes(NetworkSizes, {})
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

    def test_training_images_are_changed_and_those_of_an_evaluation_are_cropped(self, recorded: Path) -> None:
        policy, _, _ = tiny(recorded)
        batch = frames()
        batch[BASE] = torch.zeros(2, 3, 128, 128)
        batch[BASE][..., 64:] = 1.0
        cropped = policy._images(batch, changed=False)
        assert torch.equal(cropped, policy._images(batch, changed=False))
        assert not torch.equal(policy._images(batch, changed=True), policy._images(batch, changed=True))
        policy.config.image_augmentation = False
        whole = policy._images(batch, changed=True)
        assert torch.equal(whole, policy._images(batch, changed=False))
        assert not torch.equal(whole, cropped)

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
