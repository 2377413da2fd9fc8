"""One section of a JSON file that describes a model: which fields are compared, and which say nothing.

A field that says something else than what is implemented is an error; so is one that stands in no list, for
it may change what the model does. A missing field means what the original's code makes of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

# Generating is greedy, with one beam, and nothing is forbidden, forced or made less likely.
GREEDY: Mapping[str, object] = {
    **{"num_beams": 1, "num_beam_groups": 1, "num_return_sequences": 1, "diversity_penalty": 0.0},
    **{"repetition_penalty": 1.0, "no_repeat_ngram_size": 0, "encoder_no_repeat_ngram_size": 0},
    **{"bad_words_ids": None, "suppress_tokens": None, "begin_suppress_tokens": None, "min_length": 0},
    **{"forced_bos_token_id": None, "forced_eos_token_id": None, "exponential_decay_length_penalty": None},
    **{"remove_invalid_values": False, "pruned_heads": {}},
}
# transformers may write these into any section; none changes what the original infers.
OF_NO_EFFECT = frozenset(
    {
        # how it was made and is kept
        *(
            "_attn_implementation_autoset",
            "_name_or_path",
            "architectures",
            "auto_map",
            "transformers_version",
        ),
        *("torch_dtype", "dtype", "initializer_range", "torchscript", "use_bfloat16", "tf_legacy_loss"),
        # what is returned, and what is for other kinds of models
        *("return_dict", "output_attentions", "output_hidden_states", "output_scores", "use_cache"),
        *("return_dict_in_generate", "chunk_size_feed_forward", "add_cross_attention", "is_decoder"),
        *("is_encoder_decoder", "cross_attention_hidden_size", "tie_encoder_decoder", "finetuning_task"),
        *("id2label", "label2id", "problem_type", "task_specific_params", "tokenizer_class", "prefix"),
        *("decoder_start_token_id", "sep_token_id", "cache_implementation", "_from_model_config"),
        # of sampling and of beams; `predict_action` asks for neither, and limits the length itself
        *("do_sample", "temperature", "top_k", "top_p", "typical_p", "length_penalty", "early_stopping"),
        *("max_length",),
    }
)


class Field(NamedTuple):
    """What a field has to say: our value, and the original's default; without one it has to be there."""

    ours: object
    default: object = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """What a section of a file may say: fields compared, and those read elsewhere or without effect."""

    where: str
    fields: Mapping[str, Field]
    elsewhere: frozenset[str] = frozenset()

    def problems(self, found: object) -> list[str]:
        """Return a line for each field that says something else."""
        if not isinstance(found, Mapping):
            return [f"{self.where}: expected a section of fields, found {found}"]
        known = {name: Field(value, value) for name, value in GREEDY.items()} | dict(self.fields)
        lines = []
        for name, (ours, default) in known.items():
            if name in found and _plain(found[name]) != _plain(ours):
                lines.append(f"{self.where}.{name}: expected {_plain(ours)}, found {found[name]}")
            if name not in found and default != ours:
                lines.append(
                    f"{self.where}.{name}: expected {_plain(ours)}, found nothing, which means {default}"
                )
        unknown = found.keys() - known.keys() - self.elsewhere - OF_NO_EFFECT
        return lines + [
            f"{self.where}.{name}: expected no such field, found {found[name]}; its effect is not known here"
            for name in sorted(unknown)
        ]


def _plain(value: object) -> object:
    """Return what JSON would make of it: no tuples."""
    return list(value) if isinstance(value, tuple) else value
