"""OpenVLA and OpenVLA-OFT: images, prompt and, if wanted, proprioception to a chunk of actions.

Legend: B samples, N tokens of a sequence, T tokens of a prompt, K actions of a chunk, A numbers of an
action, D Llama's width.

A sequence is: beginning of text, the patches of all images, proprioception (one token, optional), the
rest of the prompt, K · A action tokens, stop, padding. With the heads `l1` and `parallel_tokens` the
action tokens are placeholders whose embeddings are zero, and every token attends to every other that is
no padding. The prediction for a placeholder is read **one position before it**, as in a language model.
Positions are counted from 0 in every row; padding is on the right.

Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
prismatic/extern/hf/modeling_prismatic.py#L499-L680 and #L850-L1010.
"""

from typing import Any, NamedTuple  # transformers is untyped here

import torch
from torch import Tensor, nn
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from vla_eval.errors import SpecMismatchError
from vla_eval.models.openvla.heads import L1Head, ProprioProjector
from vla_eval.models.openvla.sizes import NetworkOptions, NetworkSizes
from vla_eval.models.openvla.vision import FusedVision, Projector
from vla_eval.models.shared.greedy import Prompts, places_from

RMS_NORM_EPS = 1e-6  # of OpenVLA; Llama-2's own is 1e-5
ROPE_THETA = 10_000.0


class Inputs(NamedTuple):
    """Images (B, cameras, 3, H, W) in [0, 1], prompts, and normalised proprioception if it is read."""

    images: Tensor
    prompts: Prompts
    proprio: Tensor | None = None


class Sequence(NamedTuple):
    """Embeddings (B, N, D) and mask (B, N) that Llama reads, and the first action token's position (B,)."""

    embeddings: Tensor
    mask: Tensor
    first_action: Tensor


class OpenVLANetwork(nn.Module):
    """See the module's text; also the `LanguageModel` of `shared.greedy`."""

    def __init__(self, sizes: NetworkSizes, options: NetworkOptions) -> None:
        super().__init__()
        self.sizes, self.options = sizes, options
        self.vision = FusedVision(sizes)
        self.projector = Projector(sizes)
        self.llm: Any = LlamaForCausalLM(_llama_config(sizes))
        if options.proprio:
            self.proprio_projector = ProprioProjector(proprio=options.proprio, llm_width=sizes.llm_width)
        if options.head == "l1":
            self.action_head = L1Head(llm_width=sizes.llm_width, chunk=options.chunk, action=options.action)

    def sequence(self, inputs: Inputs, action_ids: Tensor | None = None) -> Sequence:
        """Return the sequence of each sample; `action_ids` (B, K · A) are tokens, None: placeholders."""
        ids, is_action, mask = self._text(inputs.prompts, action_ids)
        embeddings = self.embed(ids)
        if action_ids is None:
            embeddings = embeddings.masked_fill(is_action[..., None], 0.0)
        middle = self.projector(self.vision(inputs.images))
        if self.options.proprio:
            assert inputs.proprio is not None
            token = self.proprio_projector(inputs.proprio).to(middle.dtype)
            middle = torch.cat([middle, token], dim=1)
        n_middle = middle.shape[1]
        real = torch.ones_like(mask[:, :1]).expand(-1, n_middle)
        return Sequence(
            embeddings=torch.cat([embeddings[:, :1], middle, embeddings[:, 1:]], dim=1),
            mask=torch.cat([mask[:, :1], real, mask[:, 1:]], dim=1),
            first_action=inputs.prompts.mask.sum(dim=1) + n_middle,
        )

    def embed(self, tokens: Tensor) -> Tensor:
        """Return the embeddings (…, D) of tokens."""
        embeddings: Tensor = self.llm.model.embed_tokens(tokens)
        return embeddings

    def read(
        self, embeddings: Tensor, mask: Tensor, places: Tensor, cache: DynamicCache | None = None
    ) -> Tensor:
        """Return Llama's last hidden states (B, T, D); see `shared.greedy.LanguageModel`."""
        hidden: Tensor = self.llm.model(
            inputs_embeds=embeddings,
            # Four dimensions: transformers takes such a mask as it is and adds no causal one.
            attention_mask=mask[:, None],
            position_ids=places,
            past_key_values=cache,
            use_cache=cache is not None,
        ).last_hidden_state
        return hidden

    def logits(self, hidden: Tensor) -> Tensor:
        """Return (…, vocabulary)."""
        logits: Tensor = self.llm.lm_head(hidden)
        return logits

    def hidden(self, sequence: Sequence, *, causal: bool = False) -> Tensor:
        """Return Llama's last hidden states (B, N, D); `causal`: no token attends to a later one."""
        n = sequence.mask.shape[1]
        mask = sequence.mask[:, None, :].expand(-1, n, -1)
        if causal:
            mask = mask & torch.ones(n, n, dtype=torch.bool, device=mask.device).tril()
        return self.read(sequence.embeddings, mask, torch.arange(n, device=mask.device)[None])

    def action_states(self, sequence: Sequence, *, causal: bool = False, n_more: int = 0) -> Tensor:
        """Return the hidden states (B, K · A + n_more, D) that predict the action tokens and what follows."""
        n_tokens = self.options.n_action_tokens + n_more
        return places_from(self.hidden(sequence, causal=causal), sequence.first_action - 1, n_tokens)

    def actions(self, inputs: Inputs) -> Tensor:
        """Return normalised actions (B, K, A), float32, by the `l1` head."""
        predicted: Tensor = self.action_head(self.action_states(self.sequence(inputs)))
        return predicted

    def _text(self, prompts: Prompts, action_ids: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return ids (B, T + K · A + 1), which of them are actions, and which are not padding."""
        sizes, n_tokens = self.sizes, self.options.n_action_tokens
        lengths = prompts.mask.sum(dim=1, keepdim=True)
        n_prompt, n_samples = prompts.ids.shape[1], len(prompts.ids)
        places = torch.arange(n_prompt + n_tokens + 1, device=lengths.device).expand(n_samples, -1)
        is_action = (places >= lengths) & (places < lengths + n_tokens)
        ids = torch.full_like(places, sizes.pad_token)
        ids[:, :n_prompt] = prompts.ids
        ids = torch.where(places < lengths, ids, sizes.pad_token)
        ids = torch.where(places == lengths + n_tokens, sizes.stop_token, ids)
        if action_ids is not None:
            ids = ids.masked_scatter(is_action, action_ids)
        return ids, is_action, places <= lengths + n_tokens


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return tokenised prompts (B, T), padded on the right, with the empty token at each one's end.

    Source: the same file, #L960-L985, and prismatic/vla/datasets/datasets.py#L44-L60 at that commit.
    """
    if not bool((ids[:, 0] == sizes.bos_token).all()):
        raise SpecMismatchError(
            f"OpenVLA's prompts begin with the token {sizes.bos_token}, found {ids[:, 0].tolist()}. The "
            f"tokenizer is not the model's, or adds no special tokens."
        )
    lengths = mask.sum(dim=1)
    last = ids.gather(1, (lengths - 1)[:, None])[:, 0]
    is_missing = last != sizes.empty_token
    wider = torch.cat([ids, torch.full_like(ids[:, :1], sizes.pad_token)], dim=1)
    places = torch.arange(wider.shape[1], device=ids.device)
    ends = (places == lengths[:, None]) & is_missing[:, None]
    return Prompts(
        ids=torch.where(ends, sizes.empty_token, wider), mask=places < (lengths + is_missing)[:, None]
    )


def _llama_config(sizes: NetworkSizes) -> Any:
    return LlamaConfig(
        vocab_size=sizes.vocabulary,
        hidden_size=sizes.llm_width,
        intermediate_size=sizes.llm_mlp,
        num_hidden_layers=sizes.llm_depth,
        num_attention_heads=sizes.llm_heads,
        rms_norm_eps=RMS_NORM_EPS,
        rope_parameters={"rope_type": "default", "rope_theta": ROPE_THETA},
        max_position_embeddings=2048,
        tie_word_embeddings=False,
        bos_token_id=sizes.bos_token,
        eos_token_id=sizes.stop_token,
        attn_implementation="sdpa",
    )
