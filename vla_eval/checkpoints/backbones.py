"""Trained backbones: from the folder that `checkpoint fetch` makes, never by torchvision's download."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any  # torchvision's enumerations are partly untyped
from unittest.mock import patch

import torch
import torchvision
from torchvision.models import WeightsEnum

from vla_eval.checkpoints.bases import FOLDER, how_to_get
from vla_eval.checkpoints.closed_doors import let_through
from vla_eval.checkpoints.files import WEIGHTS_FILE
from vla_eval.errors import CheckpointError
from vla_eval.models.weights.exact import listed
from vla_eval.models.weights.file import WeightFile

FETCHED: Mapping[str, str] = {"ResNet18_Weights.IMAGENET1K_V1": "resnet18"}
"""torchvision's name of weights -> the base that holds them."""
NOT_IN_OLD_FILES = "num_batches_tracked"
WITHOUT = "Without trained weights: --set policy.pretrained_backbone_weights=null"


def check_backbone(folder: Path, name: str) -> str:
    """Compare names and shapes of weights with torchvision's network `name`; return a line or raise."""
    with torch.device("meta"):
        network = getattr(torchvision.models, name)()
    wanted = {key: tuple(x.shape) for key, x in network.state_dict().items()}
    file = folder / WEIGHTS_FILE
    found = {key: tuple(x.shape) for key, x in WeightFile(file).described().items()}
    wrong = [
        key
        for key in sorted(wanted.keys() | found.keys())
        if wanted.get(key) != found.get(key) and not (key not in found and NOT_IN_OLD_FILES in key)
    ]
    if wrong:
        raise CheckpointError(
            f"{file}: expected the names and shapes of torchvision's {name}, found others: "
            f"{listed(wrong)}. Remove the folder, and fetch it again."
        )
    return f"{name}, {len(found)} tensors with the names and shapes of torchvision's network"


@contextlib.contextmanager
def fetched_backbones() -> Iterator[None]:
    """Let torchvision take trained weights from fetched folders within the context; they have to exist."""
    download = WeightsEnum.get_state_dict

    def read(self: WeightsEnum, *args: Any, **kwargs: Any) -> Mapping[str, Any]:
        base = FETCHED.get(str(self))
        if base is None:  # torchvision's own cache or download; an error of it says how to do without
            with let_through():  # a URL and a digest that stand in torchvision, and tensors alone
                return download(self, *args, **{**kwargs, "weights_only": True})  # type: ignore[no-any-return]
        folder = FOLDER / base
        if not (folder / WEIGHTS_FILE).is_file():
            raise CheckpointError(
                f"the policy asks for {self}, and there is nothing at {folder}.{how_to_get(folder)} {WITHOUT}"
            )
        check_backbone(folder, base)
        return dict(WeightFile(folder / WEIGHTS_FILE))

    with patch.object(WeightsEnum, "get_state_dict", read):
        yield
