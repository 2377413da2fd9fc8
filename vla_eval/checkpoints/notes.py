"""What an evaluation notes of a policy's weights: digests, statistics, training seeds. Without torch."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any  # JSON of another program

from vla_eval.checkpoints.bases import no_weights
from vla_eval.checkpoints.config_check import MAX_ACTIONS
from vla_eval.checkpoints.files import (
    CONFIG_FILE,
    POSTPROCESSOR_FILE,
    PREPROCESSOR_FILE,
    TrainingFacts,
    checkpoint_sha256,
    find_checkpoint,
    read_facts,
    read_json,
    unreadable,
)
from vla_eval.checkpoints.policy_types import asked_for_steps, check_compiled
from vla_eval.checkpoints.saved_processor import SavedStep, read_saved_processor
from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.models.families import FAMILIES
from vla_eval.models.family import LEROBOT
from vla_eval.models.shared.step_names import DECODER_STEP, ENCODER_STEP, STATISTICS
from vla_eval.seeding import SeedRange
from vla_eval.strict.json_fields import get_count, get_mapping, get_text

LEROBOT_ADAPTER = LEROBOT
LEROBOT_CHECKPOINTS = frozenset(
    {
        LEROBOT_ADAPTER,
        *(
            name
            for family in FAMILIES.values()
            if family.adapter == LEROBOT_ADAPTER
            for name in family.adapters
        ),
    }
)
"""Adapters whose argument `checkpoint` names a policy of LeRobot's: it is asked with an instruction."""
CHECKPOINTS = LEROBOT_CHECKPOINTS | {family.adapter for family in FAMILIES.values()}
"""Adapters whose argument `checkpoint` names what `find_checkpoint` finds."""
AGENTS = CHECKPOINTS - LEROBOT_CHECKPOINTS
"""Those of agents: small enough for each worker, and given no instruction."""
COMPILE = "compile"
"""Their argument that asks for a compiled network."""

NEEDED_STATISTICS: Mapping[str, tuple[str, ...]] = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""What each of lerobot's kinds of normalisation takes; its other kind, IDENTITY, takes none. Source:
https://github.com/huggingface/lerobot/blob/v0.6.1/src/lerobot/processor/normalize_processor.py"""
LEROBOT_STEPS = frozenset({"normalizer_processor", "unnormalizer_processor"})
OWN_STEPS = frozenset({ENCODER_STEP, DECODER_STEP})


def checkpoint_folder(adapter: str, args: Mapping[str, Any]) -> Path | None:
    """Return the folder with the weights of a recipe's policy; None: it has none, or is another package's."""
    checkpoint = args.get("checkpoint")
    if adapter not in CHECKPOINTS or not isinstance(checkpoint, str):
        return None
    return find_checkpoint(Path(checkpoint))


def known_chunk_size(adapter: str, args: Mapping[str, Any], *, recipe: str) -> int | None:
    """Return how many actions a policy predicts at once; None where only the loaded policy knows that."""
    if adapter in CHECKPOINTS and args.get("checkpoint") is None:
        raise no_weights(recipe)
    _check_names(adapter, args, policy=recipe)
    folder = checkpoint_folder(adapter, args)
    if folder is None:
        return None
    where = str(folder / CONFIG_FILE)
    data = read_json(folder / CONFIG_FILE)
    kind = get_text(data, "type", where=where)
    if args.get(COMPILE):
        check_compiled(str(kind), policy=recipe)
    if asked_for_steps(kind):
        return 1
    return get_count(data, "chunk_size", maximum=MAX_ACTIONS, where=where)


def checkpoint_hashes(adapter: str, args: Mapping[str, Any], *, policy: str) -> dict[str, str]:
    """Return digests of all that the weights of a recipe's policy consist of, and of their training data.

    Keys: `checkpoints/POLICY`, `checkpoints/POLICY/base`, `datasets/NAME`; none for a policy without weights.
    """
    _check_names(adapter, args, policy=policy)
    folder = checkpoint_folder(adapter, args)
    if folder is None:
        return {}
    hashes = {f"checkpoints/{policy}": checkpoint_sha256(folder)}
    base = args.get("base_checkpoint")
    if isinstance(base, str):
        hashes[f"checkpoints/{policy}/base"] = checkpoint_sha256(Path(base))
    facts = read_facts(folder)
    if facts is not None:
        hashes[f"datasets/{facts.dataset}"] = facts.dataset_sha256
    return hashes


def normalization_notes(adapter: str, args: Mapping[str, Any]) -> dict[str, Any]:
    """Return by which statistics a policy, of a recipe's adapter and args, normalises and un-normalises.

    `of`: the dataset whose statistics they are, or `the checkpoint`. `before` and `after` the policy: field
    -> statistic -> numbers. Empty for a policy without a checkpoint of LeRobot's.
    """
    folder = checkpoint_folder(adapter, args) if adapter in LEROBOT_CHECKPOINTS else None
    if folder is None:
        return {}
    facts = read_facts(folder)
    return {
        "of": "the checkpoint" if facts is None else facts.dataset,
        "before": _used(folder, PREPROCESSOR_FILE),
        "after": _used(folder, POSTPROCESSOR_FILE),
    }


def training_seeds(adapter: str, args: Mapping[str, Any]) -> dict[str, tuple[SeedRange, ...]]:
    """Return task -> the seeds of whose demonstrations a policy was trained; empty: they are not known."""
    facts = _facts(adapter, args)
    return {} if facts is None else facts.seeds or {}


def training_sentences(adapter: str, args: Mapping[str, Any]) -> dict[str, tuple[str, ...]] | None:
    """Return task -> the sentences that a policy was trained with; None where they are not known."""
    facts = _facts(adapter, args)
    return None if facts is None else facts.sentences


def trained_control_mode(adapter: str, args: Mapping[str, Any]) -> str | None:
    """Return what the actions of a policy were for in training; None where that is not known."""
    facts = _facts(adapter, args)
    return None if facts is None else facts.control_mode


def _facts(adapter: str, args: Mapping[str, Any]) -> TrainingFacts | None:
    folder = checkpoint_folder(adapter, args)
    return None if folder is None else read_facts(folder)


def _used(folder: Path, processor: str) -> dict[str, dict[str, list[float]]]:
    used: dict[str, dict[str, list[float]]] = {}
    for step in read_saved_processor(folder / processor).steps:
        file = step.state_file
        if file is None or step.registry_name not in LEROBOT_STEPS | OWN_STEPS:
            continue
        state = _numbers(file)
        for field, name, key in _names(step):
            if key not in state:
                raise CheckpointError(
                    f"{file}: has no statistic '{name}' of '{field}', by which {processor} "
                    f"normalises. Fetch the complete checkpoint."
                )
            used.setdefault(field, {})[name] = state[key]
    return used


def _names(step: SavedStep) -> Iterator[tuple[str, str, str]]:
    """Yield field, statistic and the name of its tensor for all that a step uses."""
    config, where = step.config, step.where
    if step.registry_name in OWN_STEPS:
        known = {str(kind): names for kind, names in STATISTICS.items()}
        fields = get_mapping(config, "fields", where=where)
        for field in fields:
            kind = get_text(get_mapping(fields, field, where=where), "kind", where=where)
            if kind not in known:
                raise CheckpointError(
                    f"{where}: {step.name} normalises '{field}' by '{kind}', known are "
                    f"{', '.join(known)}. Use the version of mikasa-vla-eval that made the checkpoint."
                )
            for name in known[kind]:
                yield field, name, f"{field}/{name}"
        return
    features, norm_map = (get_mapping(config, key, where=where) for key in ("features", "norm_map"))
    for field in features:
        kind = get_text(get_mapping(features, field, where=where), "type", where=where)
        mode = get_text(norm_map, kind or "", where=where)
        for name in NEEDED_STATISTICS.get(mode or "IDENTITY", ()):
            yield field, name, f"{field}.{name}"


def _numbers(file: Path) -> dict[str, list[float]]:
    from safetensors.numpy import load_file  # with numpy, which most of planning does without

    try:
        tensors = load_file(file)
    except Exception as exc:  # safetensors raises a class of its own that is not public
        raise unreadable(file, exc) from exc
    return {name: [float(value) for value in values.reshape(-1)] for name, values in tensors.items()}


def _check_names(adapter: str, args: Mapping[str, Any], *, policy: str) -> None:
    for name in ("checkpoint", "base_checkpoint"):
        if adapter in CHECKPOINTS and not isinstance(args.get(name), str | None):
            raise RecipeError(
                f"policy '{policy}': args.{name} is {args[name]!r:.80}, expected the path of a folder."
            )
