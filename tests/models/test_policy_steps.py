"""Shared steps of ported policies: numbers of the original code, and nothing missing without an error."""

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.processor import PolicyProcessorPipeline
from torch import nn

from tests.models.golden_values import GoldenValues
from tests.models.spatialvla import spatialvla_golden
from vla_eval.errors import CheckpointError, RecipeError, TrainingError
from vla_eval.models.shared.gripper import Gripper
from vla_eval.models.shared.images import (
    Augmentation,
    Boxes,
    Size,
    augment,
    centre_crop,
    crop_and_resize,
    resize_and_centre_crop,
    resize_bicubic,
    resize_lanczos3,
)
from vla_eval.models.shared.normalization import Normalization, Normalizer, mask_all_but
from vla_eval.models.shared.processor_steps import DecoderStep, EncoderStep
from vla_eval.models.weights.trainable import check_lora, check_lora_target, matching, set_trainable

GOLDEN = Path(__file__).parents[1] / "golden" / "octo"
ALL7 = mask_all_but(7, left_alone=(-1,))


@pytest.fixture(scope="module")
def golden() -> GoldenValues:
    return GoldenValues(GOLDEN / "io.safetensors")


def channels_first(image: torch.Tensor) -> torch.Tensor:
    return image.permute(2, 0, 1).float()


class TestNormalizer:
    def test_mean_std_with_a_mask_is_that_of_the_original(self, golden: GoldenValues) -> None:
        spec = Normalization(kind="mean_std", mask=tuple(golden["data.norm.mask"].tolist()))
        stats = {"mean": golden["data.norm.mean"], "std": golden["data.norm.std"]}
        normalizer = Normalizer(spec, stats, where="golden")
        normalized = normalizer.normalize(golden["data.norm.actions"])
        torch.testing.assert_close(normalized, golden["data.norm.normalised"], atol=1e-6, rtol=0)
        back = normalizer.unnormalize(normalized)
        torch.testing.assert_close(back, golden["data.norm.actions"], atol=1e-6, rtol=0)

    def test_quantiles_become_one_and_what_is_beyond_is_cut(self) -> None:
        spec = Normalization(kind="q01_q99", mask=(True, True, False), clip=True)
        normalizer = Normalizer(spec, {"q01": [-2, 0, 0], "q99": [2, 10, 1]}, where="x")
        values = torch.tensor([[-2.0, 10.0, 7.0], [0.0, 5.0, 7.0], [9.0, -3.0, 7.0]])
        expected = torch.tensor([[-1.0, 1.0, 7.0], [0.0, 0.0, 7.0], [1.0, -1.0, 7.0]])
        torch.testing.assert_close(normalizer.normalize(values), expected)
        torch.testing.assert_close(normalizer.unnormalize(expected[1]), values[1])

    def test_a_dimension_whose_extremes_are_equal_is_zero_and_back_its_value(self) -> None:
        stats = {"q01": [0.3, 1.0], "q99": [0.3, 1.0], "min": [0.3, 1.0], "max": [0.3, 1.0]}
        spec = Normalization(kind="q01_q99", mask=(True, False), clip=True)
        # Without extremes, as in checkpoints from before they were kept, equal quantiles stand for them.
        for known in (stats, {name: stats[name] for name in ("q01", "q99")}):
            normalizer = Normalizer(spec, known, where="x")
            # A gripper that is always open is not normalised, and stays open.
            assert normalizer.normalize(torch.tensor([0.3, 1.0])).tolist() == [0.0, 1.0]
            back = normalizer.unnormalize(torch.tensor([0.5, 1.0]))
            assert back.tolist() == pytest.approx([0.3, 1.0])
            assert set(normalizer.statistics) == set(known)

    def test_a_dimension_that_moves_once_in_a_hundred_frames_is_at_the_ends(self) -> None:
        stats = {"q01": [0.3], "q99": [0.3], "min": [0.3], "max": [0.8]}
        normalizer = Normalizer(Normalization(kind="q01_q99", mask=(True,), clip=True), stats, where="x")
        assert normalizer.normalize(torch.tensor([[0.3], [0.8]])).flatten().tolist() == [-1.0, 1.0]
        assert normalizer.unnormalize(torch.tensor([-1.0])).item() == pytest.approx(0.3)

    def test_without_deviation_the_mean_is_zero_and_back_the_mean(self) -> None:
        spec = Normalization(kind="mean_std", mask=(True,))
        normalizer = Normalizer(spec, {"mean": [0.5], "std": [0.0]}, where="x")
        assert normalizer.normalize(torch.tensor([0.5])).item() == 0.0
        assert normalizer.unnormalize(torch.tensor([3.0])).item() == 0.5
        # The original divides by 1e-8 what does not fit its statistics.
        assert normalizer.normalize(torch.tensor([0.5 + 2**-20])).item() == pytest.approx(2**-20 / 1e-8)

    def test_q01_q99_is_that_of_the_original_and_back_what_was_not_cut(self) -> None:
        golden = spatialvla_golden.values()
        names = ("actions", "mask", "min", "max", "q01", "q99", "normalised")
        values = {name: golden[f"data.norm.{name}"] for name in names}
        spec = Normalization(kind="q01_q99", mask=tuple(values["mask"].tolist()), clip=True)
        normalizer = Normalizer(spec, values, where="golden")
        normalized = normalizer.normalize(values["actions"])
        torch.testing.assert_close(normalized, values["normalised"], atol=1e-6, rtol=0)
        is_inside = (values["normalised"].abs() < 1) | ~values["mask"]
        back = normalizer.unnormalize(normalized)
        torch.testing.assert_close(back[is_inside], values["actions"][is_inside], atol=1e-6, rtol=0)

    @pytest.mark.parametrize(
        ("stats", "message"),
        [
            ({"mean": [0.0]}, "no statistic 'std'"),
            ({"mean": [0.0], "std": [1.0, 1.0]}, "has 2 dimensions, expected 1"),
            ({"mean": [math.nan], "std": [1.0]}, "not finite"),
        ],
    )
    def test_incomplete_statistics_are_an_error(self, stats: dict[str, Any], message: str) -> None:
        with pytest.raises(CheckpointError, match=message):
            Normalizer(Normalization(kind="mean_std", mask=(True,)), stats, where="x")

    def test_what_the_mask_leaves_alone_is_cut_only_on_demand(self) -> None:
        statistics, values = {"q01": [0, 0], "q99": [2, 2]}, torch.tensor([3.0, 3.0])
        for clip_unmasked, expected in ((False, [1.0, 3.0]), (True, [1.0, 1.0])):
            spec = Normalization(kind="q01_q99", mask=(True, False), clip=True, clip_unmasked=clip_unmasked)
            assert Normalizer(spec, statistics, where="x").normalize(values).tolist() == expected
        with pytest.raises(RecipeError, match="expected clip, too"):
            Normalization(kind="q01_q99", mask=(True,), clip_unmasked=True)

    def test_an_unknown_kind_is_answered_by_a_suggestion(self) -> None:
        with pytest.raises(RecipeError, match="Did you mean 'mean_std'"):
            Normalization(kind="mean_sdt", mask=(True,))  # type: ignore[arg-type]


class TestGripper:
    @pytest.mark.parametrize(
        ("encoding", "opened", "closed"),
        [("maniskill", 1, -1), ("unit_open", 1, 0), ("unit_closed", 0, 1), ("negated", -1, 1)],
    )
    def test_each_encoding_says_open_and_closed_as_documented_and_comes_back(
        self, encoding: Any, opened: float, closed: float
    ) -> None:
        gripper = Gripper(encoding=encoding)
        actions = torch.zeros(3, 7)
        actions[:, -1] = torch.tensor([1.0, -1.0, 0.25])
        encoded = gripper.encode(actions)
        assert encoded[:2, -1].tolist() == [opened, closed]
        torch.testing.assert_close(gripper.decode(encoded), actions)

    def test_binary_executes_the_nearer_end(self) -> None:
        gripper = Gripper(encoding="unit_open", decoding="binary")
        actions = torch.tensor([[0.1], [0.49], [0.51]])
        assert gripper.decode(actions).squeeze(-1).tolist() == [-1, -1, 1]

    def test_the_papers_openvla_code_closes_where_open_was_predicted(self) -> None:
        # -sign(2 g - 1) for g = 1, -1, 0.4, 0.6
        gripper = Gripper(decoding="paper_openvla")
        predicted = torch.tensor([[1.0], [-1.0], [0.4], [0.6]])
        assert gripper.encode(predicted) is not predicted
        assert gripper.decode(predicted).squeeze(-1).tolist() == [-1, 1, 1, -1]

    def test_mistyped_names_and_impossible_pairs_are_errors(self) -> None:
        with pytest.raises(RecipeError, match="Did you mean 'maniskill'"):
            Gripper(encoding="manyskill")  # type: ignore[arg-type]
        with pytest.raises(RecipeError, match="goes with encoding maniskill"):
            Gripper(encoding="unit_open", decoding="paper_openvla")


class TestProcessorSteps:
    def steps(self, **kwargs: Any) -> tuple[EncoderStep, DecoderStep]:
        fields = {"action": Normalization(kind="mean_std", mask=ALL7)}
        stats = {"action": {"mean": np.arange(7.0), "std": np.full(7, 2.0), "max": np.ones(7)}}
        gripper = Gripper(encoding="unit_open")
        return (
            EncoderStep(fields=fields, gripper=gripper, stats=stats, **kwargs),
            DecoderStep(fields=fields, gripper=gripper, stats=stats, **kwargs),
        )

    def test_they_survive_saving_with_their_statistics_and_nothing_else(self, tmp_path: Path) -> None:
        for step in self.steps():
            PolicyProcessorPipeline(steps=[step], name="x").save_pretrained(tmp_path)
            loaded = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="x.json").steps[0]
            assert (loaded.fields, loaded.gripper) == (step.fields, step.gripper)
            assert set(loaded.state_dict()) == {"action/mean", "action/std"}
            assert loaded.missing_statistics() == []

    def test_what_is_encoded_is_decoded_again(self) -> None:
        encoder, decoder = self.steps()
        actions = torch.rand(2, 4, 7) * 2 - 1
        encoded = encoder({TransitionKey.ACTION: actions})[TransitionKey.ACTION]
        torch.testing.assert_close(encoded[..., 1], (actions[..., 1] - 1) / 2)
        torch.testing.assert_close(encoded[..., -1], (actions[..., -1] + 1) / 2)  # masked: only encoded
        torch.testing.assert_close(
            decoder({TransitionKey.ACTION: encoded})[TransitionKey.ACTION], actions, atol=1e-6, rtol=1e-6
        )

    def test_without_statistics_nothing_passes(self) -> None:
        step = DecoderStep(fields={"action": Normalization(kind="mean_std", mask=ALL7)})
        assert step.missing_statistics() == ["action.mean", "action.std"]
        with pytest.raises(CheckpointError, match=r"no statistics for action\.mean"):
            step({TransitionKey.ACTION: torch.zeros(1, 7)})

    def test_an_encoded_gripper_is_not_normalised_by_statistics_of_another_number(self) -> None:
        everything = Normalization(kind="mean_std", mask=(True,) * 7)
        with pytest.raises(RecipeError, match=r"Leave its dimension \(-1\) out"):
            EncoderStep(fields={"action": everything}, gripper=Gripper(encoding="unit_open"))


class TestImages:
    @pytest.mark.parametrize("case", ["resize_down", "resize_up", "resize_down_rect"])
    def test_resizing_is_tensorflows_to_a_level(self, golden: GoldenValues, case: str) -> None:
        expected = channels_first(golden[f"data.{case}.resized"])
        size = Size(*expected.shape[-2:])
        resized = resize_lanczos3(channels_first(golden[f"data.{case}.image"]), size)
        assert float((resized - expected).abs().max()) <= 1

    def test_a_filter_without_antialiasing_would_be_seen(self, golden: GoldenValues) -> None:
        expected = channels_first(golden["data.resize_down.resized"])
        image = channels_first(golden["data.resize_down.image"])
        other = nn.functional.interpolate(image[None], size=64, mode="bicubic")[0]
        assert float((other - expected).abs().max()) > 10

    def test_resize_and_centre_crop_are_those_of_the_originals_evaluation(self, golden: GoldenValues) -> None:
        image = channels_first(golden["data.eval_resize_crop.image"])
        cropped = resize_and_centre_crop(image[None], Size(64, 64), 0.9)[0]
        expected = channels_first(golden["data.eval_resize_crop.out"])
        assert float((cropped - expected).abs().max()) <= 1
        cut_before = centre_crop(resize_lanczos3(image, Size(64, 64))[None], 0.9)[0]
        assert float((cut_before - expected).abs().max()) > 1

    def test_a_crop_of_everything_changes_nothing_and_each_image_has_its_own(self) -> None:
        images = torch.rand(2, 3, 5, 4) * 255
        zeros, ones = torch.zeros(2), torch.ones(2)
        whole = crop_and_resize(images, Boxes(top=zeros, left=zeros, height=ones, width=ones))
        torch.testing.assert_close(whole, images)
        # The second is cropped to its first row: all rows are then alike.
        heights = torch.tensor([1.0, 0.0])
        row = crop_and_resize(images, Boxes(top=zeros, left=zeros, height=heights, width=ones))
        torch.testing.assert_close(row[0], images[0])
        torch.testing.assert_close(row[1], images[1][:, :1].expand(-1, 5, -1))

    def test_augmentation_is_alike_for_all_frames_of_a_sample_and_differs_between_samples(self) -> None:
        torch.manual_seed(0)
        frame = torch.rand(1, 1, 3, 16, 16) * 255
        spec = Augmentation(crop_area=(0.8, 1.0), brightness=0.1, contrast=(0.9, 1.1), hue=0.05)
        changed = augment(frame.expand(2, 3, -1, -1, -1), spec)
        torch.testing.assert_close(changed[:, 0], changed[:, 2])
        assert float((changed[0] - changed[1]).abs().max()) > 5
        assert float(changed.min()) >= 0 and float(changed.max()) <= 255
        assert spec.centre_area == pytest.approx(0.9)

    def test_colours_that_are_turned_by_nothing_are_the_same_and_by_a_third_change_places(self) -> None:
        images = torch.rand(1, 1, 3, 8, 8) * 255
        same = augment(images, Augmentation(saturation=(1.0, 1.0), hue=1e-9))
        torch.testing.assert_close(same, images, atol=1e-2, rtol=0)
        from vla_eval.models.shared.images import _turn_colors

        third, one = torch.full((1, 1, 1, 1, 1), 1 / 3), torch.ones(1, 1, 1, 1, 1)
        turned = _turn_colors(images / 255, one, third)
        torch.testing.assert_close(turned, (images / 255).roll(1, dims=2), atol=1e-5, rtol=0)

    def test_no_saturation_is_grey(self) -> None:
        grey = augment(torch.rand(1, 1, 3, 4, 4) * 255, Augmentation(saturation=(0.0, 0.0)))
        torch.testing.assert_close(grey[:, :, 0], grey[:, :, 1])


@pytest.mark.parametrize(
    "change",
    [
        lambda images: resize_lanczos3(images, Size(7, 5)),
        lambda images: resize_bicubic(images, Size(7, 5)),
        lambda images: resize_and_centre_crop(images, Size(7, 5), 0.9),
        lambda images: centre_crop(images, 0.9),
        lambda images: augment(images, Augmentation(crop_area=(0.5, 0.6), contrast=(0.8, 1.2), hue=0.1)),
        lambda images: crop_and_resize(images, Boxes(*(torch.full((2,), 0.3) for _ in range(4)))),
    ],
)
def test_images_are_changed_in_float32_whatever_the_network_is_run_in(change: Any) -> None:
    images = torch.rand(2, 1, 3, 16, 16, generator=torch.Generator().manual_seed(0)).mul(255).round()
    torch.manual_seed(1)
    wanted = change(images)
    for given in (images, images.bfloat16()):  # whole levels up to 255 are exact in bfloat16
        torch.manual_seed(1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = change(given)
        torch.testing.assert_close(found, wanted, rtol=0, atol=0)


class Tiny(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.q, self.v, self.head = (nn.Linear(4, 4) for _ in range(3))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.q(x) + self.v(x))  # type: ignore[no-any-return]


class TestTrainable:
    def test_only_what_a_pattern_matches_as_a_whole_is_trained(self) -> None:
        assert set_trainable(Tiny(), [r"head\..*"], what="x") == ("head.weight", "head.bias")

    @pytest.mark.parametrize(("pattern", "message"), [("haed", "matches none"), ("(", "not a regular expr")])
    def test_a_pattern_that_matches_nothing_is_an_error(self, pattern: str, message: str) -> None:
        with pytest.raises(TrainingError, match=message):
            matching(["head", "q"], [pattern], what="finetune.x")

    def test_all_linear_is_refused(self) -> None:
        with pytest.raises(TrainingError, match="also takes heads"):
            check_lora_target("all-linear")

    def test_adapters_are_on_the_named_modules_and_the_head_in_full(self) -> None:
        from peft import LoraConfig, get_peft_model

        make: Any = get_peft_model
        model = make(Tiny(), LoraConfig(r=2, target_modules="q|v", modules_to_save=["head"]))
        assert check_lora(model, "q|v", ["head"]) == ("q", "v")
        with pytest.raises(TrainingError, match="with an adapter, but not named: v"):
            check_lora(model, "q", ["head"])
        with pytest.raises(TrainingError, match="neither adapter nor named in full: head"):
            check_lora(model, "q|v")
        model.get_base_model().v.base_layer.weight.requires_grad_(True)
        with pytest.raises(TrainingError, match=r"v\.base_layer\.weight"):
            check_lora(model, "q|v", ["head"])


REGISTERED = """
from lerobot.processor import ProcessorStepRegistry
from vla_eval.checkpoints.loading import config_class
from vla_eval.checkpoints.processors import register_steps
for kind in ("mikasa_octo", "mikasa_openvla", "mikasa_spatialvla"):
    register_steps(config_class(kind, where="test"))
print(*ProcessorStepRegistry.list())
"""


@pytest.mark.slow
def test_a_new_process_knows_the_steps_of_every_ported_policy() -> None:
    """One that has trained nothing: it evaluates a checkpoint."""
    done = subprocess.run([sys.executable, "-c", REGISTERED], capture_output=True, text=True, check=True)
    own = {"mikasa_encoder", "mikasa_decoder", "mikasa_openvla_prompt", "mikasa_spatialvla_prompt"}
    assert own <= set(done.stdout.split())
