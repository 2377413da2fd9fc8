"""The π0 family, SmolVLA and ACT with few random weights, for tests of the pipeline without network or GPU.

lerobot 0.6.1 builds these models only in full size, so some names of its modules are patched while a model
is being made. Nothing on disk is changed. The results of such a model say nothing about π0's quality.
"""

import contextlib
import importlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple  # lerobot and transformers are untyped
from unittest.mock import patch

from vla_eval.checkpoints.files import CONFIG_FILE, find_checkpoint, read_json
from vla_eval.evaluation.worker import EpisodeRunner
from vla_eval.models.families import FAMILIES, TINY_POLICY, family_of
from vla_eval.models.family import imported
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.training.worker import FinetuneRunner
from vla_eval.workers.inside import Heartbeat, Runner
from vla_eval.workers.messages import Notice

TINY_RUNNER = f"{__name__}:tiny_episode_runner"
VOCABULARY = 512
CORPUS = ("remember the color and touch it", "push the cube to the goal", "which cup hides the ball")
SPECIAL_TOKENS = ("<pad>", "<eos>", "<bos>", "<unk>")
SMOLVLM_TOKENS = {
    "image_token": "<image>",
    "fake_image_token": "<fake_token_around_image>",
    "global_image_token": "<global-img>",
    "end_of_utterance_token": "<end_of_utterance>",
}


class Sizes(NamedTuple):
    """Sizes of a model of the π0 family: layers, and the widths of language model and action expert."""

    depth: int = 2
    width: int = 64
    expert_width: int = 32


@contextlib.contextmanager
def tiny_paligemma(family: str, made: Sizes = Sizes()) -> Iterator[None]:  # noqa: B008
    """Make lerobot build a model of these sizes instead of the full one, within the context."""
    modeling: Any = importlib.import_module(f"lerobot.policies.{family}.modeling_{family}")
    # 8 heads are hard-coded
    sizes = {"depth": made.depth, "num_heads": 8, "num_kv_heads": 1, "head_dim": 16}
    vlm = modeling.GemmaConfig(width=made.width, mlp_dim=2 * made.width, **sizes)
    expert = modeling.GemmaConfig(width=made.expert_width, mlp_dim=2 * made.expert_width, **sizes)
    full_vlm = modeling.PaliGemmaForConditionalGenerationWithPiGemma
    full_expert: Any = getattr(modeling, "PiGemmaForCausalLM", None)  # π0-FAST has no expert

    def make_vlm(config: Any) -> Any:
        config._vocab_size = config.text_config.vocab_size = VOCABULARY
        config.image_token_index = VOCABULARY - 1
        config.projection_dim = config.vision_config.projection_dim = vlm.width
        vision = config.vision_config
        vision.hidden_size, vision.intermediate_size, vision.patch_size = 32, 64, 14
        vision.num_hidden_layers, vision.num_attention_heads = 2, 2
        vision.image_size = TINY_POLICY["image_resolution"][0]  # π0-FAST does not change it
        return full_vlm(config=config)

    def make_expert(config: Any) -> Any:
        config.vocab_size = VOCABULARY
        return full_expert(config=config)

    with (
        patch.object(modeling, "get_gemma_config", {"gemma_2b": vlm, "gemma_300m": expert}.__getitem__),
        patch.object(modeling, "PaliGemmaForConditionalGenerationWithPiGemma", make_vlm),
        patch.object(modeling, "PiGemmaForCausalLM", make_expert, create=full_expert is None),
    ):
        yield


@contextlib.contextmanager
def tiny_resnet() -> Iterator[None]:
    """Make lerobot's ACT take one convolution instead of ResNet-18 (11 M parameters) within the context."""
    torchvision: Any = importlib.import_module("torchvision")
    nn: Any = importlib.import_module("torch").nn

    def make_resnet(**_: Any) -> Any:
        layers = {"layer4": nn.Conv2d(3, 8, kernel_size=32, stride=32), "fc": nn.Linear(8, 1)}
        return nn.ModuleDict(layers)  # an attribute of each name is all that is read

    with patch.object(torchvision.models, "resnet18", make_resnet):
        yield


def write_tiny_tokenizer(folder: Path, *, n_tokens: int | None = None) -> Path:
    """Train a tokenizer on three sentences, save it, and return its folder; `n_tokens`: if not tiny."""
    _tokenizer({}, n_tokens=n_tokens).save_pretrained(str(folder))
    return folder


def write_tiny_fast_tokenizer(folder: Path, *, n_tokens: int | None = None, min_token: int = -60) -> Path:
    """Make an action tokenizer in which each byte is a token, save it, and return its folder."""
    from vla_eval.checkpoints.fast_tokens import FastActionTokenizer

    folder.mkdir()
    made = FastActionTokenizer(_tokenizer({}, n_tokens=n_tokens), scale=10.0, min_token=min_token)
    made.save_pretrained(folder)
    return folder


def write_tiny_smolvlm(folder: Path, *, sizes: Mapping[str, Mapping[str, Any]] | None = None) -> Path:
    """Save a tiny SmolVLM's configuration and processor; `sizes` of `vision`, `text`, `whole` may differ."""
    from transformers import SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor
    from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

    tokenizer = _tokenizer(SMOLVLM_TOKENS)
    special = {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("pad", "bos", "eos")}
    own = sizes or {"vision": {}, "text": {}, "whole": {}}
    heads = {"num_attention_heads": 4, "num_key_value_heads": 2, "head_dim": 16}
    text = {"model_type": "llama", "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 4}
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    config: Any = SmolVLMConfig
    config(
        vision_config={**vision, "image_size": 64, "patch_size": 16, **own["vision"]},
        text_config={**text, **heads, **special, "vocab_size": len(tokenizer), **own["text"]},
        **{"scale_factor": 2, **own["whole"]},
        image_token_id=tokenizer.convert_tokens_to_ids(SMOLVLM_TOKENS["image_token"]),
        pad_token_id=tokenizer.pad_token_id,
    ).save_pretrained(str(folder))
    processor: Any = SmolVLMProcessor
    processor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(),
        image_seq_len=4,
    ).save_pretrained(str(folder))
    return folder


def _tokenizer(named: Mapping[str, str], *, n_tokens: int | None = None) -> Any:
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    tokenizer: Any = Tokenizer(models.BPE(unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY - 1,  # the last one is the image's
        special_tokens=[*SPECIAL_TOKENS, *named.values()],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(CORPUS, trainer)
    if n_tokens is not None:
        # `add_tokens` takes minutes for 250,000.
        model = json.loads(tokenizer.to_str())["model"]
        vocabulary = model["vocab"] | {f"<{index}>": index for index in range(len(model["vocab"]), n_tokens)}
        merges = [tuple(pair) for pair in model["merges"]]
        make_model: Any = models.BPE
        tokenizer.model = make_model(vocab=vocabulary, merges=merges, unk_token=model["unk_token"])
    make_fast: Any = PreTrainedTokenizerFast
    extra = {"extra_special_tokens": dict(named)} if named else {}
    return make_fast(
        tokenizer_object=tokenizer,
        pad_token="<pad>",
        eos_token="<eos>",
        bos_token="<bos>",
        unk_token="<unk>",
        padding_side="right",
        **extra,
    )


def make_tiny(context: PolicyContext, *, checkpoint: str, **args: Any) -> LeRobotPolicy:
    """Make a policy from a checkpoint of a family that lerobot has to be made to build tiny; an adapter."""
    family = family_of(str(read_json(find_checkpoint(Path(checkpoint)) / CONFIG_FILE).get("type")))
    with imported(family.built_tiny)(family.lerobot_type):
        return make_lerobot(context, checkpoint=checkpoint, **args)


@contextlib.contextmanager
def tiny_forms() -> Iterator[None]:
    """Let lerobot build all families that have such a form tiny within the context."""
    with contextlib.ExitStack() as stack:
        for family in FAMILIES.values():
            if family.built_tiny and not family.wraps:
                stack.enter_context(imported(family.built_tiny)(family.type))
        yield


_for_good = contextlib.ExitStack()  # in workers: it ends with the process


def tiny_episode_runner(heartbeat: Heartbeat, tell: Callable[[Notice], None], **options: Any) -> Runner:
    """Make the runner of an evaluation's worker in which they are tiny, and ACT is; see `RunnerClass`."""
    _for_good.enter_context(tiny_forms())
    _for_good.enter_context(tiny_resnet())
    return EpisodeRunner(heartbeat, tell, **options)


def tiny_finetune_runner(heartbeat: Heartbeat, tell: Callable[[Notice], None]) -> Runner:
    """Make the runner of a worker that fine-tunes, in which they are tiny; see `RunnerClass`."""
    _for_good.enter_context(tiny_forms())
    return FinetuneRunner(heartbeat, tell)
