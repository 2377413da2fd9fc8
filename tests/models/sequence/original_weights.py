"""Weights of the sequence models' original code under our names."""

import re
from collections.abc import Iterable

import torch
from torch import Tensor

Weights = dict[str, Tensor]

RENAMED = (
    (r"^r_w_bias$", "biases.content"),
    (r"^r_r_bias$", "biases.distance"),
    (r"^mem_tokens$", "first_memory"),
    (r"mha_mem_to_mem\.dense\.", "valve.out_proj."),
    (r"(dec_attn|self_attention)\.o_net\.", "attention.out."),
    (r"(dec_attn|self_attention)\.r_net\.", "attention.distance."),
    (r"self_attention\.layer_norm\.", "norms.attention."),
    (r"layer_norm1\.", "norm."),
    (r"layer_norm2\.", "feed_norm."),
    (r"pos_ff\.CoreNet\.", "feed."),
    (r"gate_mha\.", "gates.0."),
    (r"gate_mlp\.", "gates.1."),
    (r"\.bg$", ".bias"),
    (r"\.Ug\.", ".of_reset_stream."),
    (r"cross_attention1\.", "reads."),
    (r"cross_attention2\.", "writes."),
    (r"cross_rel_bias\.bias\.", "bias."),
    (r"token_norm_cross\.", "norms.reads."),
    (r"memory_norm_cross\.", "norms.writes."),
    (r"token_ffn\.layer_norm\.", "norms.feed_tokens."),
    (r"memory_ffn\.layer_norm\.", "norms.feed_memory."),
    (r"token_ffn\.core_net\.", "feed_tokens."),
    (r"memory_ffn\.core_net\.", "feed_memory."),
    (r"router\.linear\.", "router."),
    (r"shared_experts\.0\.", "experts.999."),
    (r"\.w_q\.", ".query."),
    (r"\.w_k\.", ".key."),
    (r"\.w_v\.", ".value."),
    (r"\.w_o\.", ".out."),
    (r"^ln_f\.", "norm."),
    (r"^(\d)\.norm_mamba\.", r"layers.\1.norm."),
    (r"^(\d)\.mamba\.", r"layers.\1.block."),
    (r"^(\d)\.ln2\.", r"layers.\1.feed.0."),
    (r"^(\d)\.mlp_channels\.0\.", r"layers.\1.feed.1."),
    (r"^(\d)\.mlp_channels\.2\.", r"layers.\1.feed.3."),
)
JOINED = (  # in this order, one above the other
    (r"\.(W[rzg])\.weight$", ".of_output.weight", ("Wr", "Wz", "Wg")),
    (r"\.(U[rz])\.weight$", ".of_stream.weight", ("Ur", "Uz")),
    (r"^mha_mem_to_mem\.(w[qkv])\.weight$", "valve.in_proj_weight", ("wq", "wk", "wv")),
    (r"^mha_mem_to_mem\.(w[qkv])\.bias$", "valve.in_proj_bias", ("wq", "wk", "wv")),
)
STACKED = {"gate_proj": "gates", "up_proj": "values", "down_proj": "outs"}
# Layers that the original makes and does not use in these variants.
UNUSED = (r"dec_attn\.layer_norm\.", r"pos_ff\.layer_norm\.")


def ours(original: Weights) -> Weights:
    """Return the weights under our names; matrices that we keep as one are joined, others split."""
    named: Weights = {}
    joined: dict[str, dict[str, Tensor]] = {}
    stacked: dict[str, dict[int, Tensor]] = {}
    for name, weight in original.items():
        if any(re.search(pattern, name) for pattern in UNUSED):
            continue
        name = _renamed(name)
        if found := re.search(r"^(.*)\.qkv_net\.weight$", name):
            prefix = re.sub(r"(dec_attn|self_attention)$", "attention", found[1])
            for part, rows in zip(("query", "key", "value"), weight.chunk(3), strict=True):
                named[f"{prefix}.{part}.weight"] = rows
        elif found := re.search(r"^(.*)\.experts\.(\d+)\.swiglu\.(\w+)\.weight$", name):
            stacked.setdefault(f"{found[1]}.{STACKED[found[3]]}", {})[int(found[2])] = weight
        elif pattern := next((row for row in JOINED if re.search(row[0], name)), None):
            part = re.search(pattern[0], name)
            assert part is not None
            joined.setdefault(re.sub(pattern[0], pattern[1], name), {})[part[1]] = weight
        else:
            named[name] = weight.reshape(-1, weight.shape[-1]) if name == "first_memory" else weight
    orders = {target: order for _, target, order in JOINED}
    for name, parts in joined.items():
        order = next(order for target, order in orders.items() if name.endswith(target))
        named[name] = torch.cat([parts[part] for part in order])
    for name, experts in stacked.items():
        named[name] = torch.stack([experts[number] for number in sorted(experts)])
    return named


def _renamed(name: str) -> str:
    pairs: Iterable[tuple[str, str]] = RENAMED
    for pattern, target in pairs:
        name = re.sub(pattern, target, name)
    return name
