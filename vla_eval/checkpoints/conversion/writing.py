"""What converting a published checkpoint takes, whichever policy it is. Knows no names of weights.

No code of the checkpoint is run, and only safetensors are read here. The result is a whole folder or none.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any  # JSON, lerobot and transformers

from torch import Tensor

from vla_eval.checkpoints.files import TOKENIZER_FOLDER
from vla_eval.checkpoints.foreign_code import no_foreign_code
from vla_eval.checkpoints.loading import read_weights
from vla_eval.errors import CheckpointError, did_you_mean
from vla_eval.models.shared.gripper import ENCODINGS, GripperEncoding
from vla_eval.strict.json_text import shown

TOKENIZER_FILES = ("tokenizer*", "special_tokens_map.json", "added_tokens.json")

Statistics = dict[str, dict[str, Any]]
"""Field -> statistic -> one number per dimension."""


def check_free(out: Path) -> None:
    """Refuse a folder that is there.

    Raises:
        CheckpointError: it is.
    """
    if out.exists():
        raise CheckpointError(f"{out} exists already. Name another folder.")


@contextlib.contextmanager
def folder_when_whole(out: Path) -> Iterator[Path]:
    """Give a folder to write into, which gets its name once everything is in it.

    Raises:
        CheckpointError: `out` exists.
    """
    check_free(out)
    partial = out.with_name(f".partial-{out.name}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    yield partial
    partial.rename(out)


def read_safetensors(source: Path) -> dict[str, Tensor]:
    """Return all tensors of a folder's safetensors files.

    Raises:
        CheckpointError: there are none, or one is damaged.
    """
    files = sorted(source.glob("*.safetensors"))
    if not files:
        raise CheckpointError(f"{source}: expected safetensors, found none. Fetch the whole checkpoint.")
    weights: dict[str, Tensor] = {}
    for file in files:
        weights.update(read_weights(file))
    return weights


def chosen_statistics(source: Path, known: Mapping[str, Any], unnorm_key: str | None) -> Any:
    """Return the statistics of one dataset of those a model was trained on.

    Args:
        source: the checkpoint, for messages.
        known: dataset -> its statistics.
        unnorm_key: which; None: the only one there is.

    Returns:
        What stands under that name; None if there are several and none is chosen: the checkpoint is then a
        base for fine-tuning, whose statistics are those of the new data.

    Raises:
        CheckpointError: there are none of that name.
    """
    if unnorm_key is None:
        return next(iter(known.values())) if len(known) == 1 else None
    if unnorm_key not in known:
        raise CheckpointError(
            f"{source}: there are no statistics '{unnorm_key}'.{did_you_mean(unnorm_key, known)} There are: "
            f"{', '.join(known) or 'none'}."
        )
    return known[unnorm_key]


def stated_gripper(source: Path, stated: str | None) -> GripperEncoding:
    """Return how a published policy encodes the gripper, which none of its files says.

    Statistics cannot say it: from 0 to 1 may be from closed to open, or from open to closed.

    Args:
        source: the checkpoint, for messages.
        stated: by whoever converts it.

    Raises:
        CheckpointError: it is not stated, or there is no such encoding.
    """
    for encoding in ENCODINGS:
        if stated == encoding:
            return encoding
    found = "nothing." if stated is None else f"'{stated}'.{did_you_mean(stated, ENCODINGS)}"
    raise CheckpointError(
        f"{source}: expected how its data encode the gripper (--gripper), found {found} Its files do not "
        "say it, and another encoding would execute “closed” as half open. unit_open: 0 closed to 1 open, as "
        "in Open X-Embodiment and so in the published OpenVLA and Octo; unit_closed: the opposite; "
        "maniskill: -1 closed to 1 open; negated: -1 open to 1 closed."
    )


def read_mask(source: Path, what: str, statistics: Mapping[str, Any], n_dims: int) -> tuple[bool, ...]:
    """Return which dimensions are normalised; all, where the statistics do not say it.

    Raises:
        CheckpointError: the mask has another size or holds something else.
    """
    mask = statistics.get("mask", [True] * n_dims)
    is_mask = isinstance(mask, list) and all(isinstance(value, bool) for value in mask)
    if not is_mask or len(mask) != n_dims:
        raise CheckpointError(
            f"{source}: mask of {what}: expected {n_dims} times true or false, found {shown(mask)}."
        )
    return tuple(mask)


def check_mask(source: Path, what: str, statistics: Mapping[str, Any], expected: tuple[bool, ...]) -> None:
    """Refuse statistics of other dimensions than those that are normalised.

    Raises:
        CheckpointError: they have a mask, and it is another one.
    """
    mask = statistics.get("mask")
    if mask is not None and tuple(mask) != expected:
        raise CheckpointError(f"{source}: mask of {what}: expected {expected}, found {tuple(mask)}.")


def write_checkpoint(
    source: Path,
    out: Path,
    policy: Any,
    make_processors: Callable[[], tuple[Any, Any]],
    *,
    check_tokenizer: Callable[[Any], None],
) -> Path:
    """Write a LeRobot checkpoint with a copy of the source's tokenizer; return its folder.

    Args:
        source: folder of the published checkpoint.
        out: a folder that is not there yet.
        policy: with the weights; its configuration gets the path of the tokenizer.
        make_processors: makes pre- and postprocessor from that configuration.
        check_tokenizer: is given the tokenizer, and raises if it is not the model's.

    Raises:
        CheckpointError: there is no tokenizer, or `out` exists.
    """
    with folder_when_whole(out) as partial:
        policy.config.tokenizer_name = str(_copy_tokenizer(source, partial / TOKENIZER_FOLDER))
        with no_foreign_code(policy.config.type):
            processors = make_processors()
        steps = (step for step in processors[0].steps if hasattr(step, "input_tokenizer"))
        check_tokenizer(next(steps).input_tokenizer)
        policy.config.tokenizer_name = str(out / TOKENIZER_FOLDER)
        policy.save_pretrained(partial)
        for processor in processors:
            processor.save_pretrained(partial)
    return out


def _copy_tokenizer(source: Path, folder: Path) -> Path:
    files = [file for pattern in TOKENIZER_FILES for file in sorted(source.glob(pattern)) if file.is_file()]
    if not files:
        raise CheckpointError(f"{source}: expected the tokenizer's files, found none. Fetch them, too.")
    folder.mkdir(parents=True)
    for file in files:
        shutil.copy2(file, folder / file.name)
    return folder
