"""SpatialVLA: images with places in space, and a prompt, to the tokens of a chunk of actions.

Legend: B samples, C cameras, P patches of an image, T tokens of a prompt, N of a sequence, K actions of a
chunk, D Gemma's width.

A sequence is: the patches of all images, beginning of text, prompt, newline, 3 · K action tokens, stop,
padding on the right. Places are counted from 1, as in PaliGemma. Two matrices embed tokens: Gemma's own the
words, another one the actions; both are multiplied by the root of D, and the patches are not. That is what
the original comes to, which divides the patches by that root and lets Gemma multiply everything.

Source: Qu et al. 2025 (arXiv 2501.15830), and the behaviour of the original code at
https://github.com/SpatialVLA/SpatialVLA/tree/e48075326a92116adaaf1232cf01471f15f09a73 as its golden files
show it.
"""

import math
from typing import Any, NamedTuple  # transformers is untyped here

import torch
from torch import Tensor, nn
from transformers import DynamicCache, Gemma2Config, Gemma2Model

from vla_eval.errors import SpecMismatchError
from vla_eval.models.shared.greedy import Prompts
from vla_eval.models.shared.siglip import siglip
from vla_eval.models.spatialvla.depth import DepthModel, cut_depth
from vla_eval.models.spatialvla.ego3d import Ego3DEncoding
from vla_eval.models.spatialvla.sizes import SLIDING_WINDOW, Attention, NetworkSizes

SIGLIP_MEAN = SIGLIP_STD = 0.5  # per colour
GELU = "gelu_pytorch_tanh"  # of SigLIP and of Gemma 2
RMS_NORM_EPS = 1e-6
ATTENTION_CAP, LOGIT_CAP = 50.0, 30.0  # of Gemma 2: x becomes cap · tanh(x / cap)
ROPE_THETA = 10_000.0
FIRST_PLACE = 1


class Inputs(NamedTuple):
    """The inputs of B samples."""

    images: Tensor  # (B, C, 3, H, W) in [0, 1]
    intrinsics: Tensor  # (B, C, 3, 3) of the cameras, for images of that size
    prompts: Prompts  # see there
    # (B, C, h, w) metres, of the padded images; None: the network's depth model is asked
    depth: Tensor | None = None


class Sequence(NamedTuple):
    """Embeddings (B, N, D) that Gemma reads, their numbers (B,), and the place of the first action token."""

    embeddings: Tensor
    lengths: Tensor
    first_action: Tensor


class SpatialVLANetwork(nn.Module):
    """See the module's text; also the `LanguageModel` of `shared.greedy`."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.vision = siglip(sizes, n_blocks=sizes.siglip_depth, activation=GELU)
        self.position_embedding_3d = Ego3DEncoding(sizes)
        self.projector = nn.Linear(sizes.siglip_width, sizes.llm_width)
        self.llm: Any = Gemma2Model(_gemma_config(sizes))
        self.spatial_embed_tokens = nn.Embedding(sizes.n_action_tokens, sizes.llm_width)
        nn.init.normal_(self.spatial_embed_tokens.weight, std=0.02)  # as transformers begins its own
        if sizes.llm_own_head:
            self.lm_head = nn.Linear(sizes.llm_width, sizes.vocabulary, bias=False)
        if sizes.depth_layers:
            self.depth = DepthModel(sizes)

    def image_features(self, inputs: Inputs) -> Tensor:
        """Return the tokens (B, C · P, D) of the images, one image after the other."""
        images = inputs.images.flatten(0, 1)
        seen = self.vision(((images.float() - SIGLIP_MEAN) / SIGLIP_STD).to(self.projector.weight.dtype))
        given = (
            self.depth(inputs.images.flatten(0, 1)) if inputs.depth is None else inputs.depth.flatten(0, 1)
        )
        depth = cut_depth(given, self.sizes.image_px)
        places = self.position_embedding_3d(depth, inputs.intrinsics.flatten(0, 1))
        features: Tensor = self.projector(seen.last_hidden_state + places)
        return features.reshape(len(inputs.images), -1, features.shape[-1])

    def embed(self, tokens: Tensor) -> Tensor:
        """Return the embeddings (…, D) of tokens of words and of actions."""
        is_action = tokens >= self.sizes.first_action_token
        words: Tensor = self.llm.embed_tokens(tokens.masked_fill(is_action, self.sizes.pad_token))
        actions = self.spatial_embed_tokens((tokens - self.sizes.first_action_token).clamp(min=0))
        return torch.where(is_action[..., None], actions * math.sqrt(self.sizes.llm_width), words)

    def sequence(self, inputs: Inputs, action_ids: Tensor | None = None) -> Sequence:
        """Return each sample's sequence: patches, prompt, and the tokens (B, 3 · K) of actions and stop."""
        patches = self.image_features(inputs)
        lengths, text = inputs.prompts.mask.sum(dim=1), inputs.prompts.ids
        n_more = 0
        if action_ids is not None:
            text, n_more = _followed(inputs.prompts, action_ids, self.sizes)
        embeddings = torch.cat([patches, self.embed(text).to(patches.dtype)], dim=1)
        if embeddings.shape[1] > SLIDING_WINDOW:
            raise SpecMismatchError(
                f"a sequence has {embeddings.shape[1]} tokens, expected at most {SLIDING_WINDOW}: shorten "
                "the instruction, or name fewer images."
            )
        first = lengths + patches.shape[1]
        return Sequence(embeddings, first + n_more, first)

    def mask(self, sequence: Sequence, attention: Attention) -> Tensor:
        """Return (B, N, N): which place attends to which; to padding only `bidirectional_with_padding`."""
        n = sequence.embeddings.shape[1]
        places = torch.arange(n, device=sequence.lengths.device)
        is_real = places < sequence.lengths[:, None]
        visible = (places <= places[:, None])[None].expand(len(is_real), -1, -1)
        if attention != "causal":
            visible = visible | (places < sequence.first_action[:, None])[:, None, :]
        if attention == "bidirectional_with_padding":
            return visible | ~is_real[:, None, :]
        return visible & is_real[:, None, :]

    def read(
        self, embeddings: Tensor, mask: Tensor, places: Tensor, cache: DynamicCache | None = None
    ) -> Tensor:
        """Return Gemma's last hidden states (B, T, D); see `shared.greedy.LanguageModel`."""
        added = torch.zeros(mask.shape, dtype=embeddings.dtype, device=mask.device)
        added = added.masked_fill(~mask, torch.finfo(embeddings.dtype).min)[:, None]
        hidden: Tensor = self.llm(
            inputs_embeds=embeddings,
            # The same for both kinds of blocks: no sequence is longer than a window.
            attention_mask={"full_attention": added, "sliding_attention": added},
            position_ids=places + FIRST_PLACE,
            past_key_values=cache,
            use_cache=cache is not None,
        ).last_hidden_state
        return hidden

    def hidden(self, sequence: Sequence, attention: Attention) -> Tensor:
        """Return Gemma's last hidden states (B, N, D) of whole sequences."""
        places = torch.arange(sequence.embeddings.shape[1], device=sequence.lengths.device)[None]
        return self.read(sequence.embeddings, self.mask(sequence, attention), places)

    def logits(self, hidden: Tensor) -> Tensor:
        """Return (…, vocabulary), float32."""
        head = self.lm_head.weight if self.sizes.llm_own_head else self.llm.embed_tokens.weight
        logits = nn.functional.linear(hidden, head).float()
        return LOGIT_CAP * torch.tanh(logits / LOGIT_CAP)


def _followed(prompts: Prompts, action_ids: Tensor, sizes: NetworkSizes) -> tuple[Tensor, int]:
    """Return the ids (B, T + 3 · K + 1) of prompt, actions and stop, and how many there are more."""
    lengths = prompts.mask.sum(dim=1, keepdim=True)
    stop = torch.full_like(action_ids[:, :1], sizes.stop_token)
    more = torch.cat([action_ids, stop], dim=1)
    n_samples, n_prompt = prompts.ids.shape
    ids = torch.full(
        (n_samples, n_prompt + more.shape[1]), sizes.pad_token, dtype=torch.long, device=more.device
    )
    ids[:, :n_prompt] = prompts.ids.masked_fill(~prompts.mask, sizes.pad_token)
    places = lengths + torch.arange(more.shape[1], device=more.device)
    return ids.scatter(1, places, more), more.shape[1]


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return prompts (B, T), padded on the right, with the beginning of text before each."""
    keep = mask.bool()
    last = ids.gather(1, (keep.sum(dim=1, keepdim=True) - 1).clamp(min=0))[:, 0]
    if not bool((last == sizes.newline_token).all()):
        raise SpecMismatchError(
            f"SpatialVLA's prompts end with the token {sizes.newline_token} (newline), found "
            f"{last.tolist()}. The tokenizer is not the model's: name the model's folder with `tokenizer`."
        )
    if bool((ids.masked_fill(~keep, sizes.pad_token) >= sizes.image_token).any()):
        raise SpecMismatchError(
            f"a prompt holds tokens from {sizes.image_token} on, which stand for images and actions. Leave "
            "such words out of the instruction, or name the model's own tokenizer."
        )
    has_begin = (ids[:, 0] == sizes.bos_token).all()
    if bool(has_begin):
        return Prompts(ids, keep)
    begin = torch.full_like(ids[:, :1], sizes.bos_token)
    return Prompts(torch.cat([begin, ids], dim=1), torch.cat([torch.ones_like(keep[:, :1]), keep], dim=1))


def _gemma_config(sizes: NetworkSizes) -> Any:
    return Gemma2Config(
        vocab_size=sizes.vocabulary,
        hidden_size=sizes.llm_width,
        intermediate_size=sizes.llm_mlp,
        num_hidden_layers=sizes.llm_depth,
        num_attention_heads=sizes.llm_heads,
        num_key_value_heads=sizes.llm_kv_heads,
        head_dim=sizes.llm_head_width,
        query_pre_attn_scalar=sizes.llm_head_width,
        hidden_activation=GELU,
        rms_norm_eps=RMS_NORM_EPS,
        rope_parameters={"rope_type": "default", "rope_theta": ROPE_THETA},
        attn_logit_softcapping=ATTENTION_CAP,
        final_logit_softcapping=LOGIT_CAP,
        sliding_window=SLIDING_WINDOW,
        pad_token_id=sizes.pad_token,
        eos_token_id=sizes.stop_token,
        bos_token_id=sizes.bos_token,
        # Of the kernels only this one caps attention: torch's SDPA leaves the cap out without a word.
        attn_implementation="eager",
    )
