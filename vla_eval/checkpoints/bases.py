"""The published checkpoints that recipes start from: where they are, which version, and what they become.

Standard library only, and no network: `vla_eval/checkpoints/fetching.py` fetches them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from vla_eval.errors import check_names

Converter = Literal["octo-small", "octo-base", "openvla", "spatialvla"]

WEIGHTS = ("config.json", "model.safetensors", "policy_preprocessor*", "policy_postprocessor*")
TOKENIZER = ("tokenizer*", "special_tokens_map.json", "added_tokens.json", "spiece.model")
OCTO = ("config.json", "dataset_statistics.json", "*/default/checkpoint")
SHARDS = ("*.json", "*.safetensors", "tokenizer.model")


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Files of a repository of the Hub.

    Attributes:
        repo_id: `OWNER/NAME`.
        revision: the commit that is fetched; None: the newest, which is noted beside the files.
        patterns: names of the files, as shells match them.
        folder: where they lie below the folder that is fetched; empty: in it.
    """

    repo_id: str
    revision: str | None
    patterns: tuple[str, ...]
    folder: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A published checkpoint.

    Attributes:
        name: of its folder in `checkpoints/`, as recipes name it.
        title: for people.
        terms: the licence, as its authors state it; what the Hub says of it is shown, too.
        parts: what is fetched, small parts first: one that is refused is then known before the large ones.
        converter: how the files become a LeRobot checkpoint; None: they are one.
        is_backbone: they are none, but weights of a part of a policy; the name is torchvision's.
    """

    name: str
    title: str
    terms: str
    parts: tuple[Source, ...]
    converter: Converter | None = None
    is_backbone: bool = False

    @property
    def weights(self) -> Source:
        """What holds the weights."""
        return self.parts[-1]


GEMMA = "weights: Gemma Terms of Use; code: Apache-2.0"
_PALIGEMMA = Source(
    repo_id="google/paligemma-3b-pt-224",
    revision="35e4f46485b4d07967e7e9935bc3786aad50687c",
    patterns=TOKENIZER,
    folder="tokenizer",
)
_T5 = Source(
    repo_id="google-t5/t5-base",
    revision="a9723ea7f1b39c1eae772870f3b547bf6ef7e6c1",
    patterns=TOKENIZER,
    folder="tokenizer",
)


def _octo(size: Literal["small", "base"], revision: str) -> Base:
    return Base(
        name=f"octo_{size}",
        title=f"Octo-{size} 1.5",
        terms="MIT",
        parts=(
            _T5,
            Source(repo_id=f"rail-berkeley/octo-{size}-1.5", revision=revision, patterns=OCTO),
        ),
        converter="octo-small" if size == "small" else "octo-base",
    )


_ALL = (
    Base(
        name="smolvla_base",
        title="SmolVLA",
        terms="Apache-2.0",
        parts=(
            Source(
                repo_id="HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
                revision="7b375e1b73b11138ff12fe22c8f2822d8fe03467",
                patterns=("*.json", "*.jinja", "*.txt"),  # no weights: they are in SmolVLA's
                folder="vlm",
            ),
            Source(
                repo_id="lerobot/smolvla_base",
                revision="c83c3163b8ca9b7e67c509fffd9121e66cb96205",
                patterns=WEIGHTS,
            ),
        ),
    ),
    Base(
        name="pi0_base",
        title="π0",
        terms=GEMMA,
        parts=(
            _PALIGEMMA,
            Source(
                repo_id="lerobot/pi0_base",
                revision="25c379b52ba2ff8788cab921758a3cc3fe3f77f2",
                patterns=WEIGHTS,
            ),
        ),
    ),
    Base(
        name="pi05_base",
        title="π0.5",
        terms=GEMMA,
        parts=(
            _PALIGEMMA,
            Source(
                repo_id="lerobot/pi05_base",
                revision="b211f3d44c36b6acfcf7ae94a64e8e96f75a64ba",
                patterns=WEIGHTS,
            ),
        ),
    ),
    Base(
        name="pi0_fast_base",
        title="π0-FAST",
        terms=GEMMA,
        parts=(
            _PALIGEMMA,
            Source(
                repo_id="lerobot/fast-action-tokenizer",
                revision=None,
                patterns=("*.json", "tokenizer*"),  # its code is not fetched: it is read as data
                folder="action_tokenizer",
            ),
            Source(repo_id="lerobot/pi0fast-base", revision=None, patterns=WEIGHTS),
        ),
    ),
    _octo("small", "dc9aa3019f764726c770814b27e4ab0fc6e32a58"),
    _octo("base", "ee3c10e8edd6ce2e8b1e8744d3c6fba4097bed48"),
    Base(
        name="openvla_7b",
        title="OpenVLA-7B",
        terms="MIT; derived from Llama 2, whose Community License applies",
        parts=(
            Source(
                repo_id="openvla/openvla-7b",
                revision="47a0ec7fc4ec123775a391911046cf33cf9ed83f",
                patterns=SHARDS,
            ),
        ),
        converter="openvla",
    ),
    Base(
        name="spatialvla_4b",
        title="SpatialVLA-4B",
        terms="MIT as its README states; derived from PaliGemma 2, whose Gemma Terms of Use apply",
        parts=(
            Source(
                repo_id="IPEC-COMMUNITY/spatialvla-4b-224-pt",
                revision=None,
                patterns=SHARDS,
            ),
        ),
        converter="spatialvla",
    ),
    Base(
        name="resnet18",
        title="ResNet-18 of torchvision, trained on ImageNet (IMAGENET1K_V1)",
        terms="BSD-3-Clause",
        parts=(
            Source(
                repo_id="timm/resnet18.tv_in1k",
                revision="bbd144b3e5565108aad885f145491d11bc6ce807",
                patterns=("model.safetensors",),
            ),
        ),
        is_backbone=True,
    ),
)
BASES: Mapping[str, Base] = MappingProxyType({base.name: base for base in _ALL})
OF_RECIPES: Mapping[str, str] = MappingProxyType(
    {
        "smolvla": "smolvla_base",
        "smolvla_frames": "smolvla_base",
        "smolvla_memory_tokens": "smolvla_base",
        "pi0": "pi0_base",
        "pi0_expert": "pi0_base",
        "pi0_lora": "pi0_base",
        "pi0_frames": "pi0_base",
        "pi05": "pi05_base",
        "pi05_expert": "pi05_base",
        "pi05_lora": "pi05_base",
        "pi05_frames": "pi05_base",
        "pi05_memory_tokens": "pi05_base",
        "pi0_fast": "pi0_fast_base",
        "octo_small": "octo_small",
        "octo_base": "octo_base",
        "openvla_oft": "openvla_7b",
        "spatialvla": "spatialvla_4b",
    }
)
"""Shipped recipe -> the base that it starts from."""
FIRST_TRAININGS = ("recurrent_decisions",)
"""Shipped recipes whose trainings others start from, in a folder of that name."""


def find_base(name: str) -> Base:
    """Return a base by the name of its folder or of a recipe.

    Raises:
        UnknownNameError: there is none.
    """
    known = {**OF_RECIPES, **{base: base for base in BASES}}
    check_names("base checkpoint", [name], known)
    return BASES[known[name]]


def how_to_get(path: str | Path) -> str:
    """Return a sentence with the command that makes what lies at a path; empty if no base has its name."""
    name = Path(path).name
    if name in BASES:
        return f" Get it: mikasa-vla checkpoint fetch {name}."
    if name in FIRST_TRAININGS:
        return f" Train it first: mikasa-vla finetune --policy {name} --dataset DATASET --out {path!s:.300}."
    return ""


def first_fetch(recipe: str) -> str:
    """Return a sentence with the command that fetches the base of a shipped recipe; empty if it has none."""
    base = OF_RECIPES.get(recipe)
    return "" if base is None else f" It starts from a base: first `mikasa-vla checkpoint fetch {base}`."
