"""ZoeDepth as SpatialVLA uses it, against transformers alone: it is not in the golden files."""

import functools
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from tests.models.spatialvla.spatialvla_golden import DEPTH, SMALL
from vla_eval.models.shared.greedy import Prompts
from vla_eval.models.shared.precision import default_dtype
from vla_eval.models.spatialvla.depth import PAD_PX, DepthModel, cut_depth, shown_images
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork
from vla_eval.models.spatialvla.sizes import NetworkSizes

SIZES = NetworkSizes(**{**SMALL, **DEPTH})


class Split(nn.Module):
    """Votes for the one head or the other, whatever image is the brighter for the router."""

    def forward(self, embedding: Tensor) -> Tensor:
        score = embedding.sum(dim=-1) - self.middle
        return torch.stack([score, -score], dim=-1)

    middle = 0.0


@functools.cache
def images() -> Tensor:
    return torch.rand(4, 3, 56, 56, generator=torch.Generator().manual_seed(0))


def model(*, splits: bool = False) -> DepthModel:
    """Return a model whose weights are far enough from zero to say something."""
    made, draws = DepthModel(SIZES), torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=draws) * 0.2)
    if splits:
        router, seen = Split(), []
        made.zoe.metric_head.mlp_classifier = router
        hook = made.zoe.metric_head.patch_transformer.register_forward_hook(
            lambda _module, _args, answer: seen.append(answer[:, 0].sum(dim=-1))
        )
        made(images())
        hook.remove()
        router.middle = float(seen[0].sort().values[1:3].mean())
    return made


def alone(zoe: Any, image: Tensor) -> Tensor:
    with torch.no_grad():
        depth: Tensor = zoe(shown_images(image[None], SIZES.depth_px)).predicted_depth[0]
    return depth


class TestDepth:
    @pytest.mark.parametrize("splits", [False, True])
    def test_every_image_has_the_depth_that_transformers_tells_of_it_alone(self, splits: bool) -> None:
        made = model(splits=splits)
        together = made(images())
        assert float(together.std()) > 0.01 * float(together.mean())
        for index, image in enumerate(images()):
            torch.testing.assert_close(together[index], alone(made.zoe, image), atol=0, rtol=1e-3)

    def test_transformers_batch_has_one_head_for_all(self) -> None:
        # The trap that the other test would not see if no vote differed.
        zoe = model(splits=True).zoe
        with torch.no_grad():
            batch = zoe(shown_images(images(), SIZES.depth_px))
        assert sorted(batch.domain_logits.argmax(dim=-1).tolist()) == [0, 0, 1, 1]
        told = torch.stack([alone(zoe, image) for image in images()])
        differences = ((batch.predicted_depth - told).abs() / told).amax(dim=(1, 2))
        # Two of the four were overruled.
        assert (differences > 0.05).sum() == 2 and (differences < 1e-3).sum() == 2

    def test_it_is_frozen_and_never_in_training_mode(self) -> None:
        network = SpatialVLANetwork(SIZES).train()
        assert network.vision.training and not any(part.training for part in network.depth.modules())
        assert not any(parameter.requires_grad for parameter in network.depth.parameters())
        # In training mode its eye would drop paths: two passes would differ.
        assert torch.equal(network.depth(images()), network.depth(images()))

    def test_the_network_asks_it_where_no_depth_is_given(self) -> None:
        network = SpatialVLANetwork(SIZES).eval()
        prompts = Prompts(torch.tensor([[2, 5, 4]]), torch.ones(1, 3, dtype=torch.bool))
        matrix = torch.tensor([[28.0, 0, 28], [0, 28, 28], [0, 0, 1]]).expand(1, 2, 3, 3)
        inputs = Inputs(images()[None, :2], matrix, prompts)
        given = inputs._replace(depth=network.depth(images()[:2])[None])
        with torch.no_grad():
            assert torch.equal(network.image_features(inputs), network.image_features(given))
            other = network.image_features(inputs._replace(depth=given.depth + 1.0))  # type: ignore[operator]
        assert not torch.allclose(other, network.image_features(inputs), atol=1e-3)

    def test_in_bfloat16_it_tells_float32(self) -> None:
        with default_dtype(torch.bfloat16):
            made = DepthModel(SIZES)
        assert made.zoe.dtype == torch.bfloat16
        depth = made(images())
        assert depth.dtype == torch.float32 and torch.isfinite(depth).all()


def test_images_are_shown_as_transformers_own_processor_shows_them_at_224() -> None:
    from transformers import ZoeDepthImageProcessor

    image = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    # The original resizes by cubic interpolation, transformers unless told otherwise by a linear one.
    processor: Any = ZoeDepthImageProcessor(
        size={"height": 384, "width": 384}, resample=Image.Resampling.BICUBIC
    )
    expected = processor(image, return_tensors="pt").pixel_values
    shown = shown_images(torch.from_numpy(image).permute(2, 0, 1)[None] / 255, 384)
    torch.testing.assert_close(shown, expected, atol=1e-4, rtol=0)


def test_a_plane_of_depth_is_cut_back_to_a_plane() -> None:
    # Depth that grows by 1 from the left edge of the padded image to the right one.
    ramp = torch.linspace(0, 1, 64).expand(1, 64, 64)
    cut = cut_depth(ramp, 56)
    whole = torch.linspace(0, 1, 56 + 2 * PAD_PX)
    torch.testing.assert_close(cut[0, 10], whole[PAD_PX:-PAD_PX], atol=1e-3, rtol=0)
