"""Images as TensorFlow's image functions make them: resize, crop, augment. Knows only torch.

The published VLAs were trained on images resized by `tf.image.resize(method="lanczos3", antialias=True)`;
PIL's filter of that name differs by up to 11 levels of 255 on hard edges. SpatialVLA's were resized by PIL's
bicubic filter, which is here, too. Images are (…, 3, height, width) float in levels [0, 255] here, unless
a function says otherwise.

Source of the formulas: TensorFlow v2.19.1, tensorflow/core/kernels/image/{scale_and_translate_op.cc,
sampling_kernels.h,crop_and_resize_op.cc}.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from vla_eval.errors import RecipeError
from vla_eval.models.shared.precision import in_float32

MAX_LEVEL = 255.0  # of a channel
LANCZOS_RADIUS = 3.0
CUBIC_A = -0.5  # of PIL's bicubic kernel; torch's own has -0.75 where it does not antialias
PIL_PRECISION = 1 << 22  # steps of PIL's weights


def in_numbers(images: Tensor) -> Tensor:
    """Return images in [0, 1], given that or bytes. Of bytes it takes a while: leave padding out first."""
    return images.to(torch.float32).div_(MAX_LEVEL) if images.dtype == torch.uint8 else images


def in_bytes(images: Tensor) -> Tensor:
    """Return images as bytes, given that or numbers in [0, 1]."""
    return images if images.dtype == torch.uint8 else images.mul(MAX_LEVEL).round_().to(torch.uint8)


class Size(NamedTuple):
    """Of an image, in pixels."""

    height_px: int
    width_px: int


@in_float32
def resize_lanczos3(images: Tensor, size: Size) -> Tensor:
    """Return images (…, 3, H, W) in another size, in whole levels; those of that size are left alone."""
    if tuple(images.shape[-2:]) == size:
        return images
    return _whole_levels(_resized(images, size))


@in_float32
def resize_bicubic(images: Tensor, size: Size) -> Tensor:
    """Return images (…, 3, H, W) in whole levels in another size, bit for bit as PIL's BICUBIC does it.

    Source: Pillow 12.3.0, src/libImaging/Resample.c: first along the rows, in whole levels between, with
    weights in multiples of 2⁻²².
    """
    height, width = images.shape[-2:]
    if (height, width) == size:
        return images
    columns = _bicubic_weights(width, size.width_px).to(images.device)
    rows = _bicubic_weights(height, size.height_px).to(images.device)
    along = (images.double() @ columns.T + 0.5).floor().clamp(0, MAX_LEVEL)
    return (rows @ along + 0.5).floor().clamp(0, MAX_LEVEL).to(images.dtype)


@in_float32
def resize_and_centre_crop(images: Tensor, size: Size, area: float) -> Tensor:
    """Resize, then crop the middle, as Octo's evaluation does: levels are rounded and cut once, at the end.

    Lanczos goes beyond [0, 255] at hard edges, so that cutting before the crop gives other numbers. For
    `area`, see `centre_crop`; 1: no crop.

    Source: https://github.com/octo-models/octo/blob/241fb3514b7c40957a86d869fecb7c7fc353f540/octo/utils/gym_wrappers.py#L255
    """
    if area == 1:
        return resize_lanczos3(images, size)
    resized = images if tuple(images.shape[-2:]) == size else _resized(images, size)
    return centre_crop(resized, area)


def _resized(images: Tensor, size: Size) -> Tensor:
    height, width = images.shape[-2:]
    rows = _resize_weights(height, size.height_px).to(images)
    columns = _resize_weights(width, size.width_px).to(images)
    return rows @ images @ columns.T


def _whole_levels(images: Tensor) -> Tensor:
    return images.round().clamp(0, MAX_LEVEL)


@functools.lru_cache(maxsize=32)
def _resize_weights(n_in: int, n_out: int) -> Tensor:
    """Return (n_out, n_in) of Lanczos: how much each old pixel counts in each new one; rows sum to 1."""
    distances = _distances(n_in, n_out)
    lobes = torch.sinc(distances) * torch.sinc(distances / LANCZOS_RADIUS)
    weights = torch.where(distances <= LANCZOS_RADIUS, lobes, 0.0)
    return (weights / weights.sum(dim=1, keepdim=True)).float()


@functools.lru_cache(maxsize=32)
def _bicubic_weights(n_in: int, n_out: int) -> Tensor:
    """Return (n_out, n_in), float64, of the cubic kernel with a = -0.5, in multiples of 2⁻²²."""
    x = _distances(n_in, n_out)
    near = ((CUBIC_A + 2) * x - (CUBIC_A + 3)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * CUBIC_A
    weights = torch.where(x < 1, near, torch.where(x < 2, far, 0.0))
    weights = weights / weights.sum(dim=1, keepdim=True)
    return (weights * PIL_PRECISION).round() / PIL_PRECISION


def _distances(n_in: int, n_out: int) -> Tensor:
    """Return (n_out, n_in), float64: from each new pixel to each old one, in the kernel's unit."""
    scale = n_in / n_out
    kernel_scale = max(scale, 1.0)  # antialiasing: when shrinking, the kernel covers as many more pixels
    centres = (torch.arange(n_out, dtype=torch.float64) + 0.5) * scale
    places = torch.arange(n_in, dtype=torch.float64) + 0.5
    return ((places - centres[:, None]) / kernel_scale).abs()


class Boxes(NamedTuple):
    """Where B images are cropped, as fractions of height and width, each (B,)."""

    top: Tensor
    left: Tensor
    height: Tensor
    width: Tensor


@in_float32
def crop_and_resize(images: Tensor, boxes: Boxes) -> Tensor:
    """Return crops (B, …, 3, H, W) of one box for each of the B, enlarged bilinearly, corners aligned."""
    n, (height, width) = len(images), images.shape[-2:]
    rows = _crop_weights(boxes.top, boxes.height, height)
    columns = _crop_weights(boxes.left, boxes.width, width)
    flat = images.reshape(n, -1, height, width)
    cropped = rows[:, None].to(images) @ flat @ columns[:, None].transpose(-1, -2).to(images)
    return cropped.reshape(images.shape)


def _crop_weights(start: Tensor, length: Tensor, n_px: int) -> Tensor:
    """Return (B, n_px, n_px): weights of linear interpolation between the two nearest pixels."""
    steps = torch.arange(n_px, device=start.device, dtype=torch.float32)
    places = (start[:, None] * (n_px - 1) + steps * length[:, None]).clamp(0, n_px - 1)
    return (1 - (places[..., None] - steps).abs()).clamp(min=0)


@in_float32
def centre_crop(images: Tensor, area: float, *, whole: Callable[[Tensor], Tensor] = _whole_levels) -> Tensor:
    """Return the middle `area` (0, 1] of images (B, …, 3, H, W), enlarged, in whole levels."""
    if not 0 < area <= 1:
        raise RecipeError(f"crop area is {area}, expected a number in (0, 1].")
    side = math.sqrt(area)
    ones = torch.ones(len(images), device=images.device)
    margin = ones * (1 - side) / 2
    boxes = Boxes(top=margin, left=margin, height=ones * side, width=ones * side)
    return whole(crop_and_resize(images, boxes))


@in_float32
def truncated_levels(images: Tensor) -> Tensor:
    """Return whole levels as TensorFlow makes bytes of numbers in [0, 1]: 255.5 times as much, truncated.

    That is not rounding: 10.9 becomes 10, and 250.1 becomes 250.

    Source: https://github.com/tensorflow/tensorflow/blob/v2.19.1/tensorflow/python/ops/image_ops_impl.py
    (`convert_image_dtype`).
    """
    return (images * ((MAX_LEVEL + 0.5) / MAX_LEVEL)).floor().clamp(0, MAX_LEVEL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """Random changes of training images, in this order; one draw per sample and camera."""

    # least and largest share of the area that is kept; None: no crop
    crop_area: tuple[float, float] | None = None
    crop_ratio: tuple[float, float] = (1.0, 1.0)  # least and largest width / height of the crop
    brightness: float = 0.0  # up to so much is added, of the range 1
    # least and largest factor about each image's mean, per colour
    contrast: tuple[float, float] = (1.0, 1.0)
    saturation: tuple[float, float] = (1.0, 1.0)  # least and largest factor
    hue: float = 0.0  # turned by up to so much of a full circle

    @property
    def centre_area(self) -> float:
        """Area of the centre crop in evaluation that goes with the random crop in training: its mean."""
        return sum(self.crop_area) / 2 if self.crop_area is not None else 1.0


@in_float32
def augment(images: Tensor, spec: Augmentation) -> Tensor:
    """Return changed images (B, T, 3, H, W); draws from torch's global generator, which the loop seeds."""
    n = len(images)
    if spec.crop_area is not None:
        images = crop_and_resize(images, _random_boxes(n, spec, images.device))
    unit = images / MAX_LEVEL
    per_image = (n, *[1] * (images.ndim - 1))

    def drawn(low: float, high: float) -> Tensor:
        return torch.empty(n, device=images.device).uniform_(low, high).reshape(per_image)

    if spec.brightness:
        unit = unit + drawn(-spec.brightness, spec.brightness)
    if spec.contrast != (1.0, 1.0):
        mean = unit.mean(dim=(-2, -1), keepdim=True)
        unit = (unit - mean) * drawn(*spec.contrast) + mean
    if spec.saturation != (1.0, 1.0) or spec.hue:
        unit = _turn_colors(unit.clamp(0, 1), drawn(*spec.saturation), drawn(-spec.hue, spec.hue))
    return (unit * MAX_LEVEL).clamp(0, MAX_LEVEL)


def _random_boxes(n: int, spec: Augmentation, device: torch.device) -> Boxes:
    assert spec.crop_area is not None
    area = torch.empty(n, device=device).uniform_(*spec.crop_area)
    low, high = (math.log(ratio) for ratio in spec.crop_ratio)
    ratio = torch.empty(n, device=device).uniform_(low, high).exp()
    height, width = ((area / ratio).sqrt().clamp(max=1), (area * ratio).sqrt().clamp(max=1))
    top, left = (torch.rand(n, device=device) * (1 - side) for side in (height, width))
    return Boxes(top=top, left=left, height=height, width=width)


def _turn_colors(unit: Tensor, saturation: Tensor, turn: Tensor) -> Tensor:
    """Change saturation and hue in HSV; images (…, 3, H, W) in [0, 1]."""
    value, brightest = unit.max(dim=-3)
    spread = value - unit.min(dim=-3).values
    red, green, blue = unit.unbind(dim=-3)
    safe = spread.clamp(min=1e-12)
    sixths = torch.where(
        brightest == 0,
        (green - blue) / safe,
        torch.where(brightest == 1, 2 + (blue - red) / safe, 4 + (red - green) / safe),
    )
    hue = (sixths / 6 + turn.squeeze(-3)) % 1
    chroma = ((spread / value.clamp(min=1e-12)) * saturation.squeeze(-3)).clamp(0, 1) * value
    # Each colour is value - chroma × a trapezoid of the hue, moved by a third of the circle.
    colors = []
    for offset in (5.0, 3.0, 1.0):
        place = (offset + 6 * hue) % 6
        colors.append(value - chroma * torch.minimum(place, 4 - place).clamp(0, 1))
    return torch.stack(colors, dim=-3)
