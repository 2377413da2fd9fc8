"""What stands in for files that LeRobot's configurations name: policies are built without a network."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple  # Any: fields of lerobot's configurations

from vla_eval.models.families import TINY_POLICY
from vla_eval.testing import tiny_models

PALIGEMMA_TOKENS, FAST_TOKENS, FAST_MIN_TOKEN = 257_152, 2_048, -354
"""Vocabularies of PaliGemma and of the FAST action tokenizer, and its lowest coefficient.

Source: lerobot's `modeling_pi0_fast.py`; `processor_config.json` of physical-intelligence/fast as public
code quotes it.
"""
DECODING_STEPS, TINY_DECODING_STEPS = 48, 6
"""Tokens of π0-FAST per inference: those of 4 steps, prefix and end. Random weights do not write an end, and
the 256 of its recipe would take minutes on a CPU. The cache of all 256 takes 5 MB."""
PUBLISHED_SMOLVLM: Mapping[str, Mapping[str, Any]] = {
    "vision": {
        "hidden_size": 768,
        "intermediate_size": 3072,
        "num_hidden_layers": 12,
        "num_attention_heads": 12,
        "image_size": 512,
        "patch_size": 16,
    },
    "text": {
        "hidden_size": 960,
        "intermediate_size": 2560,
        "num_hidden_layers": 32,
        "num_attention_heads": 15,
        "num_key_value_heads": 5,
        "head_dim": 64,
        "vocab_size": 49280,
    },
    "whole": {"scale_factor": 4},
}
"""Sizes of SmolVLM2-500M-Video-Instruct; SmolVLA then has the published 450,046,176 parameters."""


class StandIn(NamedTuple):
    """Fields of the configuration, and the folder of a tokenizer where the processors need one."""

    fields: dict[str, Any]
    tokenizer: Path | None = None


def smolvlm(folder: Path, tiny: bool) -> StandIn:
    """Write the description of SmolVLA's language model."""
    sizes = None if tiny else PUBLISHED_SMOLVLM
    return StandIn({"vlm_model_name": str(tiny_models.write_tiny_smolvlm(folder / "vlm", sizes=sizes))})


def paligemma(folder: Path, tiny: bool) -> StandIn:
    """Write the tokenizer of π0 and π0.5."""
    return StandIn(dict(TINY_POLICY) if tiny else {}, tiny_models.write_tiny_tokenizer(folder / "tokenizer"))


def paligemma_with_action_tokens(folder: Path, tiny: bool) -> StandIn:
    """Write the two tokenizers of π0-FAST."""
    n_text, n_actions = (tiny_models.VOCABULARY, None) if tiny else (PALIGEMMA_TOKENS, FAST_TOKENS)
    text = tiny_models.write_tiny_tokenizer(folder / "tokenizer", n_tokens=n_text)
    actions = tiny_models.write_tiny_fast_tokenizer(
        folder / "action_tokenizer", n_tokens=n_actions, min_token=FAST_MIN_TOKEN
    )
    fields = {
        "text_tokenizer_name": str(text),
        "action_tokenizer_name": str(actions),
        "validate_action_token_prefix": False,  # random weights do not write `Action:`
        "max_decoding_steps": TINY_DECODING_STEPS if tiny else DECODING_STEPS,
        **(TINY_POLICY if tiny else {}),
    }
    fields.pop("num_inference_steps", None)  # it denoises nothing
    return StandIn(fields, text)
