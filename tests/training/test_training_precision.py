"""In a bfloat16 training step images, geometry and heads are float32: real steps of the tiny recipes."""

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.models.memory.action_head import ActionHead
from vla_eval.models.octo.diffusion_head import DiffusionHead
from vla_eval.models.octo.transformer import OctoTransformer
from vla_eval.models.openvla.heads import ProprioProjector, ResidualMlp
from vla_eval.models.openvla.network import OpenVLANetwork
from vla_eval.models.spatialvla import ego3d
from vla_eval.models.spatialvla.network import SpatialVLANetwork
from vla_eval.policies.lerobot.device import autocast
from vla_eval.training.finetune import finetune
from vla_eval.training.loop import autocast_dtype

ONE_STEP = {"steps": 1, "batch_size": 2, "save_every_steps": 1, "log_every_steps": 1, "num_workers": 0}
BOTH = ["observation.images.base", "observation.images.wrist"]
BFLOAT16, AMP = {"dtype": "bfloat16"}, {"use_amp": True}
Train = Callable[..., None]


class Call(NamedTuple):
    """Arguments and result of one call of a function."""

    args: tuple[Any, ...]
    result: Any


@pytest.fixture
def train(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Train:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def one_step(recipe: str, **policy: Any) -> None:
        finetune(
            FinetuneConfig(
                policy=recipe,
                dataset=str(recorded),
                out=str(tmp_path / f"{recipe}-{len(list(tmp_path.iterdir()))}"),
                finetune={**ONE_STEP, "policy": policy},
                device="cpu",
                allow_unreplayed=True,
            )
        )

    return one_step


def calls_of(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[Call]:
    """Return the list of what is passed to a function and what it returns, which grows with each call."""
    calls: list[Call] = []
    original = getattr(owner, name)

    def watched(*args: Any) -> Any:
        calls.append(Call(args, original(*args)))
        return calls[-1].result

    monkeypatch.setattr(owner, name, watched)
    return calls


@pytest.mark.parametrize(
    ("recipe", "precision", "reader", "heads"),
    [
        ("openvla_oft_tiny", BFLOAT16, (OpenVLANetwork, "sequence"), [ResidualMlp, ProprioProjector]),
        ("octo_tiny", AMP, (OctoTransformer, "image_tokens"), [DiffusionHead]),
    ],
)
def test_images_and_heads_are_those_of_a_float32_step(
    train: Train,
    monkeypatch: pytest.MonkeyPatch,
    recipe: str,
    precision: dict[str, Any],
    reader: tuple[Any, str],
    heads: list[Any],
) -> None:
    policy = {"use_proprio": True} if recipe == "openvla_oft_tiny" else {"augment": True}
    calls = calls_of(monkeypatch, *reader)
    train(recipe, **policy)
    differences = {head: differences_from_float32(monkeypatch, head) for head in heads}
    train(recipe, **policy, **precision)
    exact, found = (images(call.args[1]) for call in calls)
    for wanted, shown in zip(exact, found, strict=True):
        torch.testing.assert_close(shown, wanted, rtol=0, atol=0)
    assert all(of_head and max(of_head) == 0 for of_head in differences.values())


def test_the_positive_controls_head_is_that_of_a_float32_step(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    differences = differences_from_float32(monkeypatch, ActionHead)
    train("memory", channels=4, heads=2, key=4, memory=8, hidden=16, **AMP)
    assert differences and max(differences) == 0


def differences_from_float32(monkeypatch: pytest.MonkeyPatch, head: Any) -> list[float]:
    """Return how far each result is from what the head makes of the same inputs, not under autocast."""
    forward = head.forward
    differences: list[float] = []

    def watched(module: Any, *inputs: Tensor) -> Any:
        result = forward(module, *inputs)
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            alone = forward(module, *(part.float() for part in inputs))
        for found, wanted in zip(flat(result), flat(alone), strict=True):
            assert found.dtype == torch.float32
            differences.append(float((found - wanted).abs().max()))
        return result

    monkeypatch.setattr(head, "forward", watched)
    return differences


def flat(result: Any) -> tuple[Tensor, ...]:
    return (result,) if isinstance(result, Tensor) else tuple(result)


def images(shown: Any) -> list[Tensor]:
    """Return what a network is shown: Octo's images by camera, or all in one."""
    return list(shown.images.values()) if isinstance(shown.images, dict) else [shown.images]


def test_images_points_and_their_sines_are_those_of_a_float32_step(
    train: Train, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = calls_of(monkeypatch, SpatialVLANetwork, "image_features")
    train("spatialvla_tiny", pictures=BOTH)
    points = calls_of(monkeypatch, ego3d, "patch_points")
    waves = calls_of(monkeypatch, ego3d, "frequencies")
    train("spatialvla_tiny", pictures=BOTH, **BFLOAT16)
    torch.testing.assert_close(calls[1].args[1].images, calls[0].args[1].images, rtol=0, atol=0)
    # The depth model is bfloat16, and so its depth another one; what is made of it is float32.
    ((depth, matrices, sizes), found_m) = points[0]
    assert depth.dtype == found_m.dtype == waves[0].result.dtype == torch.float32
    expected_m = points_in_space(depth.double(), matrices.double(), sizes)
    # float32 has 24 bits: 6e-8 of the number, and some roundings.
    torch.testing.assert_close(found_m.double(), expected_m, rtol=1e-6, atol=1e-6)
    columns = position_columns(expected_m)
    # The fastest angle is 128 times half the point's coordinate: an error of 1e-6 m becomes 6e-5.
    torch.testing.assert_close(waves[0].result.double(), columns, rtol=0, atol=2e-4)


def points_in_space(depth: Tensor, matrices: Tensor, sizes: Any) -> Tensor:
    """Return (N, patches, 12): the middle of each quarter of a patch, at its mean depth (pinhole camera)."""
    n_side = 2 * sizes.image_px // sizes.patch_px
    edge_px = sizes.patch_px // 2
    z = depth.reshape(len(depth), n_side, edge_px, n_side, edge_px).mean(dim=(2, 4))
    middles = (torch.arange(n_side, dtype=torch.float64) + 0.5) * edge_px
    focal_x, focal_y = matrices[:, 0, 0], matrices[:, 1, 1]
    x = z * (middles[None, None, :] - matrices[:, 0, 2, None, None]) / focal_x[:, None, None]
    y = z * (middles[None, :, None] - matrices[:, 1, 2, None, None]) / focal_y[:, None, None]
    rows = torch.stack([x, y, z], dim=-1).unfold(1, 2, 2).unfold(2, 2, 2)  # (N, patch, patch, 3, 2, 2)
    return rows.permute(0, 1, 2, 4, 5, 3).reshape(len(depth), -1, 12)


def position_columns(points_m: Tensor) -> Tensor:
    """Return (…, 12 · 17): each coordinate from 2 m ahead in units of 2 m, its 8 sines and its 8 cosines."""
    scaled = (points_m - torch.tensor([0.0, 0.0, 2.0] * 4)) / 2
    angles = [scaled * 2**power for power in range(8)]
    columns = [scaled, *(angle.sin() for angle in angles), *(angle.cos() for angle in angles)]
    return torch.stack(columns, dim=-1).flatten(-2)


def test_the_fastest_column_turns_by_128_radians_in_two_metres() -> None:
    """The columns that the test above expects, by hand: 2 m to the right of what is 2 m ahead."""
    columns = position_columns(torch.tensor([[2.0, 0.0, 2.0] * 4], dtype=torch.float64))
    assert columns.shape == (1, 204)
    assert float(columns[0, 8]) == pytest.approx(math.sin(128))


@pytest.mark.parametrize(
    ("fields", "launched", "expected"),
    [
        ({"dtype": "bfloat16"}, "", torch.bfloat16),
        ({"dtype": "float32", "use_amp": True}, "bf16", None),
        ({"use_amp": True}, "", torch.bfloat16),  # torch's own choice on a CPU
        ({"use_amp": False}, "bf16", torch.bfloat16),
        ({"use_amp": False}, "no", None),
        ({"use_amp": False}, "", None),
    ],
)
def test_the_recipe_says_the_precision_and_else_accelerates_launcher(
    monkeypatch: pytest.MonkeyPatch, fields: dict[str, Any], launched: str, expected: Any
) -> None:
    monkeypatch.setenv("ACCELERATE_MIXED_PRECISION", launched)
    assert autocast_dtype(SimpleNamespace(**fields), "cpu") == expected


@pytest.mark.filterwarnings("ignore:CUDA is not available")
@pytest.mark.parametrize(("knows_bfloat16", "expected"), [(True, torch.bfloat16), (False, torch.float16)])
def test_a_gpu_trains_and_acts_in_the_precision_of_a_cpu_if_it_knows_it(
    monkeypatch: pytest.MonkeyPatch, knows_bfloat16: bool, expected: torch.dtype
) -> None:
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: knows_bfloat16)
    assert autocast_dtype(SimpleNamespace(use_amp=True), "cuda:0") == expected
    acting: Any = autocast(SimpleNamespace(use_amp=True, device="cuda:0"))
    assert acting.fast_dtype == expected
