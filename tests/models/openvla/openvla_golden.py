"""What the original code of OpenVLA-OFT made of tiny random weights; see the README beside the files."""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.models import golden_folder
from vla_eval.models.openvla.network import OpenVLANetwork
from vla_eval.models.openvla.sizes import N_BINS, NetworkOptions, NetworkSizes
from vla_eval.models.openvla.vision import DINO_MLP_RATIO
from vla_eval.models.openvla.weight_names import to_ours
from vla_eval.models.shared.greedy import Prompts
from vla_eval.models.weights.exact import put_weights

FOLDER = Path(__file__).parents[2] / "golden" / "openvla_oft"
TOLERANCE = 2e-5  # absolute, float32 on CPU; from the README of the golden files


values = functools.partial(golden_folder.stored_values, FOLDER)
config = functools.partial(golden_folder.description, FOLDER)


def sizes_of(described: Mapping[str, Any]) -> dict[str, int]:
    """Return what the fixture's description says of sizes and tokens."""
    dino, siglip, llm, tokens = (described[name] for name in ("dino", "siglip", "llm", "tokens"))
    assert described["n_action_bins"] == N_BINS and dino["mlp_ratio"] == DINO_MLP_RATIO
    # The first bin is the last of the tokenizer's tokens, the last one follows `action_token_begin_idx`.
    return {
        "image_px": described["image_size"],
        "patch_px": described["patch_size"],
        "dino_width": dino["embed_dim"],
        "dino_depth": dino["depth"],
        "dino_heads": dino["num_heads"],
        "dino_registers": dino["register_tokens"],
        "siglip_width": siglip["embed_dim"],
        "siglip_depth": siglip["depth"],
        "siglip_heads": siglip["num_heads"],
        "siglip_mlp": int(siglip["embed_dim"] * siglip["mlp_ratio"]),
        "llm_width": llm["hidden_size"],
        "llm_depth": llm["num_hidden_layers"],
        "llm_heads": llm["num_attention_heads"],
        "llm_mlp": llm["intermediate_size"],
        "vocabulary": llm["vocab_size"],
        "text_vocabulary": tokens["action_token_begin_idx"] + 1 + N_BINS,
        "bos_token": tokens["bos"],
        "stop_token": tokens["stop"],
        "pad_token": tokens["pad"],
        "empty_token": tokens["empty"],
    }


SMALL = sizes_of(config())
SIZES = NetworkSizes(**SMALL)
padded = functools.partial(golden_folder.padded, pad_token=SIZES.pad_token)
CHUNK: int = config()["num_actions_chunk"]
ACTION: int = config()["action_dim"]
PROPRIO: int = config()["proprio_dim"]
UNNORM_KEY = "tiny"


@functools.cache
def original_weights() -> dict[str, Tensor]:
    """Return all weights by the original's names, `vla.` left out; sparse tables filled up with zeros."""
    weights = {}
    for name, tensor in load_file(FOLDER / "weights.safetensors").items():
        name = name.removeprefix("vla.")
        if name.endswith("@rows"):
            table = torch.zeros(SIZES.vocabulary, tensor.shape[1])
            rows = load_file(FOLDER / "weights.safetensors")[f"vla.{name.removesuffix('@rows')}@row_ids"]
            table[rows] = tensor
            weights[name.removesuffix("@rows")] = table
        elif not name.endswith("@row_ids"):
            weights[name] = tensor
    return weights


def network(**options: Any) -> OpenVLANetwork:
    made = OpenVLANetwork(SIZES, NetworkOptions(**{"chunk": CHUNK, "action": ACTION, **options}))
    ours = to_ours(original_weights(), SIZES)
    wanted = made.state_dict()
    extra = ("action_head.", "proprio_projector.")
    ours = {name: value for name, value in ours.items() if name in wanted or not name.startswith(extra)}
    put_weights(made, ours, where="golden weights")
    return made.eval()


def images(n_cameras: int) -> Tensor:
    """Return (samples, cameras, 3, edge, edge) in [0, 1]."""
    return values()["in.images"][:, :n_cameras].permute(0, 1, 4, 2, 3).float() / 255


def prompts(*names: str) -> Prompts:
    """Return prompts, padded to the same length; the empty token is there as the original appends it."""
    rows = []
    for name in names:
        ids = values()[f"in.{name}_input_ids"][0].tolist()
        rows.append(ids if ids[-1] == SIZES.empty_token else [*ids, SIZES.empty_token])
    return padded(rows)


def training_prompts() -> Prompts:
    ids, labels = values()["train.input_ids"], values()["train.labels"]
    ignored = config()["tokens"]["ignore_index"]
    rows = [
        row[: int((label != ignored).nonzero()[0])].tolist() for row, label in zip(ids, labels, strict=True)
    ]
    return padded(rows)


def word_tokenizer() -> Any:
    """Return a tokenizer of words that makes the stored prompts of the sentences "pick" and "nothing".

    The second stored prompt has no instruction, which ours refuse: the word for it is taken out here.
    """
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    question = ("What", "action", "should", "the", "robot", "take", "to", "pick", "?")
    words = ("<s>", "In", ":", *question, "\n", "Out", ":")
    ids = values()["in.prompt1_input_ids"][0].tolist()
    named = {**dict(zip(words, ids, strict=True)), "</s>": SIZES.stop_token, "<pad>": SIZES.pad_token}
    others = {f"<{n}>": n for n in range(SIZES.pad_token) if n not in named.values()}
    tokenizer: Any = Tokenizer(models.WordLevel({**others, **named}, "<0>"))
    tokenizer.normalizer = normalizers.Replace("nothing", "")
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(" ", "removed"),
            pre_tokenizers.Split("\n", "isolated"),
            pre_tokenizers.Punctuation("isolated"),
        ]
    )
    tokenizer.post_processor = processors.TemplateProcessing(
        single="<s> $A", special_tokens=[("<s>", SIZES.bos_token)]
    )
    make: Any = PreTrainedTokenizerFast
    special = {"unk_token": "<0>", "bos_token": "<s>", "eos_token": "</s>", "pad_token": "<pad>"}
    return make(tokenizer_object=tokenizer, **special)


def write_published(folder: Path) -> Path:
    """Write a folder as the OFT scripts leave it, with the stored weights; return it."""
    heads = ("action_head", "proprio_projector")
    weights = original_weights()
    names = sorted(name for name in weights if not name.startswith(heads))
    for index, part in enumerate((names[::2], names[1::2])):
        save_file({name: weights[name].contiguous() for name in part}, folder / f"model-{index}.safetensors")
    for head in heads:
        tensors = {
            f"module.{name.removeprefix(f'{head}.')}": x
            for name, x in weights.items()
            if name.startswith(head)
        }
        torch.save(tensors, folder / f"{head}--50000_checkpoint.pt")
    statistics = {"action": config()["action_statistics"], "proprio": config()["proprio_statistics"]}
    (folder / "dataset_statistics.json").write_text(json.dumps({UNNORM_KEY: statistics}))
    (folder / "config.json").write_text(json.dumps({"model_type": "openvla"}))
    word_tokenizer().save_pretrained(str(folder))
    return folder
