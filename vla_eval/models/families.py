"""The families of policies: a row for each that needs more than its configuration says."""

import importlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vla_eval.models.family import Base, Family, Source, Tiny

WEIGHTS = ("config.json", "model.safetensors", "policy_preprocessor*", "policy_postprocessor*")
TOKENIZER = ("tokenizer*", "special_tokens_map.json", "added_tokens.json", "spiece.model")
OCTO = ("config.json", "dataset_statistics.json", "*/default/checkpoint")
SHARDS = ("*.json", "*.safetensors", "tokenizer.model")
GEMMA = "weights: Gemma Terms of Use; code: Apache-2.0"
OPEN_X = {"gripper": "unit_open"}  # of Open X-Embodiment, on which all that are converted were trained
BYTES = {"tokenizer_name": "bytes"}
TINY_POLICY: Mapping[str, Any] = {
    "chunk_size": 4,
    "n_action_steps": 4,
    "num_inference_steps": 2,
    "image_resolution": [56, 56],
    "dtype": "float32",
}
"""Fields of a tiny policy of the π0 family."""
AGENT = "mikasa_agent"
"""Type of what was trained by rewards; no policy of LeRobot's."""
_BY_TOKENS = "it writes its actions token by token, each in a pass of another shape"
_HAS_MEMORY = "it is small, and its memory has other shapes at each step"
_STAGES = "vla_eval.models.shared.stages"
_STAND_INS = "vla_eval.testing.stand_ins"
_TINY_PALIGEMMA = "vla_eval.testing.tiny_models:tiny_paligemma"
_PALIGEMMA = Source(
    repo_id="google/paligemma-3b-pt-224",
    revision="35e4f46485b4d07967e7e9935bc3786aad50687c",
    patterns=TOKENIZER,
    folder="tokenizer",
)


def _of_lerobot(name: str, title: str, repo_id: str, revision: str | None, *parts: Source) -> Base:
    """Return a base of the π0 family: PaliGemma's tokenizer, further parts, and lerobot's weights."""
    weights = Source(repo_id=f"lerobot/{repo_id}", revision=revision, patterns=WEIGHTS)
    return Base(name=name, title=title, terms=GEMMA, parts=(_PALIGEMMA, *parts, weights))


def _octo_base(size: str, revision: str, fields: Mapping[str, Any]) -> Base:
    return Base(
        name=f"octo_{size}",
        title=f"Octo-{size} 1.5",
        terms="MIT",
        parts=(
            Source(
                repo_id="google-t5/t5-base",
                revision="a9723ea7f1b39c1eae772870f3b547bf6ef7e6c1",
                patterns=TOKENIZER,
                folder="tokenizer",
            ),
            Source(repo_id=f"rail-berkeley/octo-{size}-1.5", revision=revision, patterns=OCTO),
        ),
        # Any of the statistics that it has: a fine-tuning replaces them.
        options={
            "size": size,
            "dataset": "bridge_dataset",
            **OPEN_X,
            "tokenizer": "{source}/tokenizer",
        },
        fields=fields,
    )


_SMOLVLA = Family(
    type="smolvla",
    is_built_empty=True,
    traced_positions="model.vlm_with_expert.vlm.model.vision_model.embeddings",
    noise="flow",
    stages=f"{_STAGES}:smolvlm_with_expert",
    stand_in=f"{_STAND_INS}:smolvlm",
    built_tiny="contextlib:nullcontext",  # the description that stands in makes it tiny
    bases=(
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
    ),
)
_PI0 = Family(
    type="pi0",
    is_built_empty=True,
    noise="flow",
    stages=f"{_STAGES}:paligemma_with_expert",
    stand_in=f"{_STAND_INS}:paligemma",
    built_tiny=_TINY_PALIGEMMA,
    tiny=Tiny(fields={**TINY_POLICY, "gradient_checkpointing": False, "scheduler_decay_steps": 2}),
    bases=(_of_lerobot("pi0_base", "π0", "pi0_base", "25c379b52ba2ff8788cab921758a3cc3fe3f77f2"),),
)
_PI05 = replace(
    _PI0,
    type="pi05",
    stages=f"{_STAGES}:paligemma_with_expert_and_state_in_prompt",
    # lerobot 0.6.1 looks for π0.5's projections of time under π0's names, and leaves them frozen
    # (https://github.com/huggingface/lerobot/pull/4494).
    lora_targets=r"(.*\.gemma_expert\..*\.self_attn\.(q|v)_proj"
    r"|model\.(action_in_proj|action_out_proj|time_mlp_in|time_mlp_out))",
    tiny=None,
    bases=(_of_lerobot("pi05_base", "π0.5", "pi05_base", "b211f3d44c36b6acfcf7ae94a64e8e96f75a64ba"),),
)


def _ours(folder: str, docs: str) -> dict[str, Any]:
    """Return the fields of a row that follow from the names of our modules and functions."""
    configuration = f"vla_eval.models.{folder}.configuration_{folder}"
    return {
        "type": f"mikasa_{folder}",
        "configuration": configuration,
        "docs": f"docs/{docs}.md",
        "stages": f"{configuration}:network_stages",
    }


def _converted(folder: str, options: str) -> dict[str, Any]:
    module = f"vla_eval.models.{folder}.conversion"
    return {"converter": f"{module}:read_original", "convert_options": f"{module}_options:{options}"}


_ADDS_MEMORY: dict[str, Any] = {
    "configuration": "vla_eval.models.vla_memory.configuration_vla_memory",
    "docs": "docs/vla_memory.md",
    "bases": (),
    "tiny": None,
}

_ROWS = (
    Family(
        type="act",
        draws_nothing=True,
        stages=f"{_STAGES}:resnet_and_transformer",
        saved_per_linear=1.04,
        counts_all_layers=True,
        tiny=Tiny(),
        bases=(
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
        ),
    ),
    Family(
        type="diffusion",
        cuts_chunk=True,
        compiled=("diffusion.unet.forward",),  # its scheduler looks at each step's number
        noise="ddim",
        stages=f"{_STAGES}:resnet_and_unet",
        saved_per_linear=1.19,
        counts_all_layers=True,
        # Its own recipes are small, but for the U-Net.
        tiny=Tiny(fields={"down_dims": [16, 32], "n_groups": 4, "num_inference_steps": 2}, sets_chunk=False),
    ),
    _SMOLVLA,
    _PI0,
    _PI05,
    replace(
        _PI0,
        type="pi0_fast",
        noise=None,
        cuts_chunk=True,
        not_compiled=_BY_TOKENS,
        stages=f"{_STAGES}:paligemma_alone",
        stand_in=f"{_STAND_INS}:paligemma_with_action_tokens",
        tiny=None,
        # Its action tokenizer is read as data.
        replaces={
            f"{module}:AutoProcessor": "vla_eval.checkpoints.fast_tokens:FastProcessors"
            for module in (
                "lerobot.policies.pi0_fast.modeling_pi0_fast",
                "lerobot.processor.tokenizer_processor",
            )
        },
        bases=(
            _of_lerobot(
                "pi0_fast_base",
                "π0-FAST",
                "pi0fast-base",
                None,
                Source(
                    repo_id="lerobot/fast-action-tokenizer",
                    revision=None,
                    patterns=("*.json", "tokenizer*"),  # its code is not fetched: it is read as data
                    folder="action_tokenizer",
                ),
            ),
        ),
    ),
    # What lerobot 0.6 has besides these, where its configuration does not say it.
    Family(type="multi_task_dit", queues=("_queues",)),
    Family(type="tdmpc", queues=("_queues", "_prev_mean")),
    Family(type="vqbet", queues=("_queues",)),
    Family(
        type="gaussian_actor",
        why_not="it has no chunks, and learns by reinforcement, not from demonstrations",
    ),
    Family(
        type="lingbot_va",
        why_not="it keeps what it has seen and done inside its networks, for one episode at a time",
    ),
    Family(
        type=AGENT,
        adapter="agent",
        adapters={"agent": "vla_eval.policies.agents.policy:make_agent"},
        docs="docs/agents.md",
        why_not="it was trained by rewards, and runs by the adapter 'agent'",
        not_compiled="it is small",
    ),
    Family(type="groot", cuts_chunk=True),
    Family(type="molmoact2", cuts_chunk=True),
    Family(
        not_compiled=_HAS_MEMORY,
        **_ours("memory", "positive_control"),
        saved_per_linear=1.91,
        counts_all_layers=True,
        tiny=Tiny(),
    ),
    Family(
        **_ours("offline_rl", "offline_rl"),
        saved_per_linear=1.4,
        counts_all_layers=True,
        tiny=Tiny(),
    ),
    Family(
        not_compiled=_HAS_MEMORY,
        **_ours("sequence", "sequence_policies"),
        saved_per_linear=1.1,
        counts_all_layers=True,
        tiny=Tiny(),
    ),
    replace(_SMOLVLA, type="mikasa_smolvla", wraps=_SMOLVLA.type, **_ADDS_MEMORY),
    replace(_PI0, type="mikasa_pi0", wraps=_PI0.type, **_ADDS_MEMORY),
    replace(_PI05, type="mikasa_pi05", wraps=_PI05.type, **_ADDS_MEMORY),
    Family(
        **_ours("octo", "octo"),
        is_built_empty=True,
        compiled=("network.transformer.forward", "network.head.sample"),  # prompts are embedded once
        stand_in_fields=BYTES,
        tiny=Tiny(recipe="octo_tiny"),
        **_converted("octo", "OctoOptions"),
        bases=(
            _octo_base("small", "dc9aa3019f764726c770814b27e4ab0fc6e32a58", {}),
            # Source: octo/model/components/transformer.py of the original, `vit_b`; `vit_s` is the default.
            _octo_base(
                "base",
                "ee3c10e8edd6ce2e8b1e8744d3c6fba4097bed48",
                {"width": 768, "layers": 12, "heads": 12, "mlp_width": 3072},
            ),
        ),
    ),
    Family(
        **_ours("openvla", "openvla"),
        is_built_empty=True,
        compiled=("network.actions",),  # of the continuous head
        stand_in_fields=BYTES,
        tiny=Tiny(recipe="openvla_oft_tiny"),
        **_converted("openvla", "OpenVLAOptions"),
        adapters={"openvla": "vla_eval.policies.lerobot.paper_compat:make_paper_compat"},
        bases=(
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
                options={**OPEN_X, "image_augmentation": False},
            ),
        ),
    ),
    Family(
        **_ours("spatialvla", "spatialvla"),
        is_built_empty=True,
        not_compiled=_BY_TOKENS,
        saved_per_linear=1.9,
        stand_in_fields={
            **BYTES,  # whose tokens have these numbers
            "sizes": {"pad_token": 0, "bos_token": 1, "stop_token": 2, "newline_token": 201},
        },
        tiny=Tiny(recipe="spatialvla_tiny"),
        **_converted("spatialvla", "SpatialVLAOptions"),
        bases=(
            Base(
                name="spatialvla_4b",
                title="SpatialVLA-4B",
                terms="MIT as its README states; derived from PaliGemma 2, whose Gemma Terms of Use apply",
                parts=(
                    Source(repo_id="IPEC-COMMUNITY/spatialvla-4b-224-pt", revision=None, patterns=SHARDS),
                ),
                options={},
            ),
        ),
    ),
)
FAMILIES: dict[str, Family] = {family.type: family for family in _ROWS}
"""Type -> its row; a test may add one."""


def family_of(kind: str) -> Family:
    """Return the row of a type; one that says nothing for a type without a row."""
    return FAMILIES.get(kind) or Family(type=kind)


def register_families() -> None:
    """Import the configurations of our families, which registers them with lerobot."""
    for family in FAMILIES.values():
        if family.configuration:
            importlib.import_module(family.configuration)


def bases() -> dict[str, Base]:
    """Return the published checkpoints by the names of their folders."""
    return {base.name: base for family in FAMILIES.values() for base in family.bases}


def family_of_base(base: Base) -> Family:
    """Return the row that a base stands in."""
    return next(row for row in FAMILIES.values() if base.name in (one.name for one in row.bases))
