"""What LoRA trains of SpatialVLA, by name. Knows nothing of peft.

The original names ends of modules (`q_proj`, `out_proj`, `linear` …) in the whole model, which also hits the
`out_proj` of four blocks of the frozen depth model; here whole names are given, and none of those. Source:
scripts/spatialvla_4b_finetune/finetune_lora.sh and train/spatialvla_finetune.py of the original at
https://github.com/SpatialVLA/SpatialVLA/tree/e48075326a92116adaaf1232cf01471f15f09a73.
"""

_SIGLIP = r"vision\.encoder\.layers\.\d+\.(self_attn\.(q_proj|k_proj|v_proj|out_proj)|mlp\.fc[12])"
_GEMMA = r"llm\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
_PLACES = r"position_embedding_3d\.position_embedding_head\.[03]"
LORA_TARGETS = rf"network\.({_SIGLIP}|{_GEMMA}|{_PLACES}|projector)"
"""Regular expression of the modules that get an adapter; it has to match a whole name."""
SPATIAL_EMBEDDINGS = "spatial_embed_tokens"
"""Module that is trained in full beside the adapters, if it is asked for; the original leaves it as it is."""
