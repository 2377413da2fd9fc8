"""Load a LeRobot checkpoint so that nothing is missing without an error: configuration, weights, processors.

lerobot's own loaders leave out what does not fit (`strict=False`), and those of π0, π0.5 and π0-FAST
answer a failed load with random weights. Here every parameter is compared with the file afterwards.
Only safetensors are read; nothing is downloaded unless `HF_HUB_OFFLINE=0` is set.
"""

import contextlib
import dataclasses
import functools
import os
import sys
from collections.abc import Iterator, Mapping, Sequence

# Before lerobot is imported, which reads it once: an evaluation must not depend on the network.
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any  # lerobot is untyped: its configs, policies and processors are Any here

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins
from torch import Tensor

from vla_eval.checkpoints.adapter_config import read_adapter_config
from vla_eval.checkpoints.config_check import check_config, check_features
from vla_eval.checkpoints.execution_fields import without_execution
from vla_eval.checkpoints.files import (
    ADAPTER_CONFIG_FILE,
    ADAPTER_WEIGHTS_FILE,
    CONFIG_FILE,
    WEIGHTS_FILE,
    adapter_base,
    adapter_bases,
    find_checkpoint,
    read_json,
)
from vla_eval.checkpoints.foreign_code import no_foreign_code, only_data
from vla_eval.checkpoints.plain_errors import plain_errors, raise_plainly, says_what_is_missing
from vla_eval.checkpoints.processors import check_statistics, load_processors, own_tokenizers
from vla_eval.checkpoints.saved_processor import refuse_built_in_normalization
from vla_eval.errors import CheckpointError, VlaEvalError, unknown_name
from vla_eval.models.families import family_of, register_families
from vla_eval.models.family import LEROBOT
from vla_eval.models.weights.empty import empty_weights
from vla_eval.models.weights.exact import check_same, put_weights
from vla_eval.models.weights.file import WeightFile

register_families()

# Fields that make a constructor fetch weights which the checkpoint is about to replace.
NO_DOWNLOADS: dict[str, object] = {"pretrained_backbone_weights": None, "load_vlm_weights": False}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """How to load."""

    device: str  # `cpu`, `cuda`, `cuda:1` …
    # `float32` or `bfloat16`, for policies that have such a setting; None: as saved
    dtype: str | None = None
    # folder of the tokenizer; None: the one in the checkpoint, else the one it names
    tokenizer: str | None = None
    # where the base of a LoRA adapter lies; None: where it was in training
    base_checkpoint: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedPolicy:
    """A policy ready for inference: `preprocessor`, `policy`, `postprocessor`, in this order."""

    folder: Path
    config: Any
    policy: Any
    preprocessor: Any
    postprocessor: Any

    @contextlib.contextmanager
    def acting(self) -> Iterator[None]:
        """Let the policy infer within the context, as safely and with the same errors as it was loaded."""
        # Some policies open a tokenizer only in their first pass.
        with plain_errors(self.folder, self.config.type, "cannot infer"), only_data():
            yield


def load_checkpoint(path: Path, options: LoadOptions) -> LoadedPolicy:
    """Load policy and processors of a checkpoint or a run folder, or say what is missing or does not fit."""
    folder = find_checkpoint(path)
    config = read_config(folder, options)
    with plain_errors(folder, config.type, "cannot be loaded"):
        with no_foreign_code(config.type):
            policy = load_weights(folder, config, options)
            preprocessor, postprocessor = load_processors(folder, config, tokenizer=options.tokenizer)
        policy.eval()
        check_statistics(folder, preprocessor, postprocessor)
    return LoadedPolicy(
        folder=folder, config=config, policy=policy, preprocessor=preprocessor, postprocessor=postprocessor
    )


def read_config(folder: Path, options: LoadOptions) -> Any:
    """Return the policy's configuration, set to the wanted device and precision."""
    refuse_built_in_normalization(folder)
    data = read_json(folder / CONFIG_FILE)
    kind = data.pop("type", None)
    where = str(folder / CONFIG_FILE)
    cls = config_class(str(kind), where=where)
    data["device"] = options.device
    if options.dtype is not None:
        if "dtype" not in data:
            raise CheckpointError(
                f"{folder}: a policy of type '{kind}' has no setting `dtype`. Leave `dtype` out of its "
                "recipe."
            )
        data["dtype"] = options.dtype
    # Also where the file does not have the field: its default may be weights that would be downloaded.
    closed = {name: value for name, value in NO_DOWNLOADS.items() if name in cls.__dataclass_fields__}
    data = with_local_files({**closed, **data}, folder, tokenizer=options.tokenizer)
    check_config(cls, data, where=where)
    try:
        with only_data():  # some configurations open the backbone that they name
            config = draccus.decode(cls, without_execution(data))
    except CheckpointError:
        raise
    except OSError as exc:  # of a backbone that is not here
        raise_plainly(exc, asked_for(cls, str(kind), data))
    except Exception as exc:  # draccus has no class of its own for all that can be wrong
        raise CheckpointError(
            f"{where}: not the configuration of a '{kind}' policy of the installed lerobot: {exc!s:.1000}"
        ) from exc
    check_features(config, where=where)
    return config


def asked_for(cls: Any, kind: str, data: Mapping[str, Any]) -> Any:
    """Return type and fields of a configuration that could not be made, for messages."""
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    return SimpleNamespace(**{**defaults, **data, "type": kind})


def with_local_files(data: dict[str, Any], folder: Path, *, tokenizer: str | None) -> dict[str, Any]:
    """Return a configuration that asks for no download, and for the tokenizers of its checkpoint."""
    here = {**NO_DOWNLOADS, **own_tokenizers(folder, tokenizer)}
    return {**data, **{name: value for name, value in here.items() if name in data}}


def config_class(kind: str, *, where: str) -> Any:
    """Return lerobot's configuration class of a type; refuse one that this loop cannot ask for chunks."""
    register_families()
    _register_plugins(_search_path())
    known = list(PreTrainedConfig.get_known_choices())
    family = family_of(kind)
    if family.adapter != LEROBOT:
        raise CheckpointError(
            f"{where}: '{kind}' is no policy of LeRobot's: {family.why_not}. `mikasa-vla eval --policy "
            f"FOLDER` evaluates it; see {family.docs}."
        )
    if kind not in known:
        error = unknown_name("LeRobot policy type", kind[:100], known, where=where)
        raise CheckpointError(
            f"{error} A policy of your own has to be installed as a package `lerobot_policy_…`."
        )
    why_not = family.why_not
    if why_not:
        raise CheckpointError(
            f"{where}: a LeRobot policy of type '{kind}' cannot be evaluated in this loop, which asks for "
            f"whole chunks and hides no frame: {why_not}. For it there is "
            "LeRobot's own loop: lerobot-eval --env.type=mikasa (docs/lerobot_commands.md)."
        )
    return PreTrainedConfig.get_choice_class(kind)


@functools.cache
def _register_plugins(_where: tuple[tuple[str, int], ...]) -> None:
    """Import installed plugins. lerobot reads the metadata of each package for it, at each call."""
    register_third_party_plugins()


def _search_path() -> tuple[tuple[str, int], ...]:
    """Return the folders that packages are found in, with the time of the last change of each."""
    folders = [(place or ".", Path(place or ".")) for place in sys.path]
    return tuple((place, folder.stat().st_mtime_ns) for place, folder in folders if folder.exists())


def make_empty_policy(config: Any, *, where: Path | None = None, **kwargs: Any) -> Any:
    """Return a policy as its constructor makes it, with further arguments; some load a tokenizer."""
    try:
        with no_foreign_code(config.type):
            return get_policy_class(config.type)(config, **kwargs)
    except VlaEvalError:
        raise
    except ImportError as exc:
        raise_plainly(exc, config)
    except Exception as exc:  # the constructors raise what they like of a configuration that does not fit
        if isinstance(exc, OSError | RuntimeError) and says_what_is_missing(exc):
            raise_plainly(exc, config)
        of = "" if where is None else f"{where}: "
        raise CheckpointError(
            f"{of}a LeRobot policy of type '{config.type}' cannot be built as its configuration says: "
            f"{exc!s:.500} Expected sizes that belong together and fit into memory; fetch the checkpoint "
            "again."
        ) from exc


def load_weights(folder: Path, config: Any, options: LoadOptions, **kwargs: Any) -> Any:
    """Return the policy with exactly the weights of a checkpoint; `kwargs` are its constructor's."""
    return fill_policy(make_unfilled_policy(config, where=folder, **kwargs), folder, options).to(
        config.device
    )


def make_unfilled_policy(config: Any, **kwargs: Any) -> Any:
    """Return a policy that is about to be filled, or only counted: large ones have no memory for weights."""
    with empty_weights() if family_of(config.type).is_built_empty else contextlib.nullcontext():
        return make_empty_policy(config, **kwargs)


def fill_policy(policy: Any, folder: Path, options: LoadOptions, *, may_be_new: Sequence[str] = ()) -> Any:
    """Put a checkpoint's weights, or its adapter, into a policy and return it; see `put_weights`."""
    if (folder / ADAPTER_CONFIG_FILE).is_file():
        return _fill_adapter(policy, folder, options)
    weights = WeightFile(folder / WEIGHTS_FILE)
    put_weights(
        policy,
        weights,
        where=str(folder / WEIGHTS_FILE),
        cast=options.dtype is not None,
        may_be_new=may_be_new,
        device=options.device,
    )
    return policy


def begin_from(policy: Any, base: Path) -> None:
    """Let a policy prepare its base's weights for training; refuse an adapter, whose base was prepared."""
    begin = getattr(policy, "begin_from_base", None)
    if begin is None:
        return
    if (base / ADAPTER_CONFIG_FILE).is_file():
        raise CheckpointError(
            f"{base}: a policy of this type begins from whole weights, found a LoRA adapter. Merge it with "
            "`mikasa-vla checkpoint merge`, and name the result as the base."
        )
    begin()


def _fill_adapter(policy: Any, folder: Path, options: LoadOptions) -> Any:
    """Load a LoRA adapter on top of the checkpoint that it was trained on."""
    from peft import get_peft_model_state_dict  # optional extra of lerobot

    bases = adapter_bases(folder, base_checkpoint=options.base_checkpoint)
    if not bases:
        base = options.base_checkpoint or adapter_base(folder)
        raise CheckpointError(
            f"{folder}: a LoRA adapter needs the checkpoint it was trained on, which was at {base} and is "
            f"not there. Name its folder with `base_checkpoint` in the recipe's args."
        )
    file = folder / ADAPTER_WEIGHTS_FILE
    config, weights = read_adapter_config(folder / ADAPTER_CONFIG_FILE), dict(WeightFile(file))
    # What the adapter was trained with in full comes with it: the base need not have it.
    names = config.modules_to_save or ()
    beside = [start for start in getattr(policy, "new_in_finetuning", ()) if start.split(".")[-2] in names]
    named = dataclasses.replace(options, base_checkpoint=None)  # the adapter's base, not that of its base
    filled = fill_policy(policy, bases[0], named, may_be_new=beside)
    begin_from(filled, bases[0])
    wrapped = _with_adapter(filled, config, weights, where=str(file))
    # peft, too, leaves out what does not fit.
    check_same(get_peft_model_state_dict(wrapped), weights, where=str(file))
    return wrapped


def _with_adapter(policy: Any, config: Any, weights: Mapping[str, Tensor], *, where: str) -> Any:
    """Put a LoRA adapter on a policy; peft reads no file for it."""
    from peft import PeftModel, set_peft_model_state_dict

    try:
        wrapped: Any = PeftModel(policy, config)
        set_peft_model_state_dict(wrapped, dict(weights))
    except (ValueError, RuntimeError, KeyError) as exc:
        raise CheckpointError(
            f"{where}: the adapter does not fit its base: {exc!s:.500} Name the base's folder with "
            "`base_checkpoint` in the recipe's args."
        ) from exc
    return wrapped
