"""What LoRA trains of OpenVLA, by name. Knows nothing of peft.

The original says `all-linear` of a transformers model, which spares its output embeddings: all linear
layers of both vision encoders, the projector and Llama, but not `lm_head`. The heads are outside of it and
trained in full. For a whole policy `all-linear` would take `lm_head` and the heads, too; hence names.
Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
vla-scripts/finetune.py#L846-L860. It also puts adapters on blocks whose output is not used; ours are not
there. Its encoders have one matrix for query, key and value, ours have three: the same rank makes ours freer.
"""

_DINO = (
    r"vision\.dino\.encoder\.layer\.\d+\."
    r"(attention\.attention\.(query|key|value)|attention\.output\.dense|mlp\.fc[12])"
)
_SIGLIP = r"vision\.siglip\.encoder\.layers\.\d+\.(self_attn\.(q_proj|k_proj|v_proj|out_proj)|mlp\.fc[12])"
_PROJECTOR = r"projector\.fc[123]"
_LLAMA = r"llm\.model\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
LORA_TARGETS = rf"network\.({_DINO}|{_SIGLIP}|{_PROJECTOR}|{_LLAMA})"
"""Regular expression of the modules that get an adapter; it has to match a whole name."""
FULL_MODULES = ("action_head", "proprio_projector")
"""Modules that are new in fine-tuning and trained in full."""
