"""Tiny SmolVLA, π0 and π0.5 with and without memory, and batches for them."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from vla_eval.checkpoints.loading import config_class, make_empty_policy
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, STATE_KEY
from vla_eval.models.shared.earlier_frames import mask_field
from vla_eval.testing.tiny_models import TINY_POLICY, tiny_paligemma, write_tiny_smolvlm

FAMILIES = ("smolvla", "pi0", "pi05")
BASE, WRIST = CAMERA_KEYS.values()
N_STATE, N_ACTION, N_PX, N_WORDS = 10, 7, 64, 5
TINY_SMOLVLA: dict[str, Any] = {
    **{"load_vlm_weights": False, "num_vlm_layers": 2, "resize_imgs_with_padding": [64, 64], "num_steps": 2},
    **{"chunk_size": 4, "n_action_steps": 4},
}


@contextlib.contextmanager
def tiny(family: str) -> Iterator[None]:
    """Let lerobot build this family in its tiny form."""
    with contextlib.nullcontext() if family == "smolvla" else tiny_paligemma(family):  # type: ignore[arg-type]
        yield


def fields_of(family: str, folder: Path, **changes: Any) -> dict[str, Any]:
    """Return fields of the configuration."""
    own = TINY_POLICY
    if family == "smolvla":
        vlm = folder / "vlm"
        own = {**TINY_SMOLVLA, "vlm_model_name": str(vlm if vlm.is_dir() else write_tiny_smolvlm(vlm))}
    return {**own, **changes}


def made(kind: str, folder: Path, **changes: Any) -> Any:
    """Return a policy of this type with random weights, the same for the same shapes."""
    family = kind.removeprefix("mikasa_")
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, N_PX, N_PX))
    config = config_class(kind, where="test")(
        device="cpu",
        input_features={
            **{BASE: image, WRIST: image},
            STATE_KEY: PolicyFeature(type=FeatureType.STATE, shape=(N_STATE,)),
        },
        output_features={ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(N_ACTION,))},
        **fields_of(family, folder, **changes),
    )
    torch.manual_seed(0)
    with tiny(family):
        policy = make_empty_policy(config)
    return policy.eval()


def batch_of(n: int, *, seed: int = 1, policy: Any = None) -> dict[str, Any]:
    """Return a batch (B, …) as preprocessors leave it; for a policy with places, random images in all."""
    draws = torch.Generator().manual_seed(seed)
    batch: dict[str, Any] = {
        **{key: torch.rand(n, 3, N_PX, N_PX, generator=draws) for key in (BASE, WRIST)},
        STATE_KEY: torch.randn(n, N_STATE, generator=draws).clamp(-1, 1),
        ACTION_KEY: torch.randn(n, 4, N_ACTION, generator=draws),
        "action_is_pad": torch.zeros(n, 4, dtype=torch.bool),
        "observation.language.tokens": torch.randint(5, 100, (n, N_WORDS), generator=draws),
        "observation.language.attention_mask": torch.ones(n, N_WORDS, dtype=torch.bool),
    }
    for key in policy.config.memory_fields if policy is not None else ():
        batch[key] = torch.rand(n, 3, N_PX, N_PX, generator=draws)
        batch[mask_field(key)] = torch.ones(n, dtype=torch.bool)
    return batch


def noise_of(policy: Any, n: int) -> Tensor:
    """Return the noise of an inference."""
    shape = (n, policy.config.chunk_size, policy.config.max_action_dim)
    return torch.randn(shape, generator=torch.Generator().manual_seed(7))


def loss_of(policy: Any, batch: dict[str, Any]) -> Tensor:
    """Return the loss with the draws of a fixed seed."""
    torch.manual_seed(3)
    loss: Tensor = policy.forward(batch)[0]
    return loss
