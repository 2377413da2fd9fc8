"""Shared by several verbs: kinds of arguments, exit codes, the typed command."""

import argparse
import contextlib
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from vla_eval.errors import RecipeError
from vla_eval.storage.shard import Shard
from vla_eval.strict.bounds import MAX_EPISODES, check_seeds
from vla_eval.strict.renamed import warn_renamed

if TYPE_CHECKING:
    from vla_eval.training.dry_run import DryRunOptions

EXIT_EPISODE_ERRORS = 3
"""All episodes were run, and some ended in an error."""


def add_verb(subparsers: "argparse._SubParsersAction[Any]", name: str, **texts: Any) -> Any:
    """Add a verb whose texts are printed as they are written; its flags cannot be abbreviated."""
    formatter = argparse.RawDescriptionHelpFormatter
    return subparsers.add_parser(name, formatter_class=formatter, allow_abbrev=False, **texts)


def typed_command() -> str:
    """Return the command that is running, as a shell takes it."""
    return shlex.join(["mikasa-vla", *sys.argv[1:]])


@contextlib.contextmanager
def dry_run_options(args: argparse.Namespace) -> "Iterator[DryRunOptions]":
    """Give what `finetune --dry-run` assumes; where a base is missing, networks of the published sizes."""
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.testing.random_checkpoint import published_sizes
    from vla_eval.training.dry_run import DryRunOptions

    with published_sizes() as assume:
        yield DryRunOptions(device_bytes=args.device_memory, tflops=args.tflops, assume=assume)


def workers_argument(text: str) -> int | str:
    """Read the value of `--workers`: a number, or `auto`."""
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError as exc:
        raise argparse.ArgumentTypeError(f"expected 'auto' or a number, found '{text}'") from exc


def add_workers(parser: argparse.ArgumentParser, *, default: str | None = None) -> None:
    """Declare `--workers W`; without a default the recipe says how many."""
    parser.add_argument(
        "--workers",
        type=workers_argument,
        default=default,
        metavar="W",
        help="processes, or 'auto': one per core",
    )


def add_allow_environment_change(parser: argparse.ArgumentParser, *, consequence: str = "") -> None:
    """Declare `--allow-environment-change`."""
    parser.add_argument(
        "--allow-environment-change",
        action="store_true",
        help=f"resume although package versions or the machine have changed{consequence}",
    )


def seeds_argument(text: str) -> range:
    """Read the value of `--seeds`: `1-100`, or one seed."""
    first, _, last = text.partition("-")
    try:
        lowest, highest = int(first), int(last or first)
        check_seeds(lowest, name="--seeds")
        check_seeds(highest, name="--seeds")
    except (ValueError, RecipeError) as exc:
        raise argparse.ArgumentTypeError(f"expected seeds such as 1-100, found '{text}'") from exc
    if highest < lowest:
        raise argparse.ArgumentTypeError(f"expected the lower seed first, found '{text}'")
    if highest - lowest >= MAX_EPISODES:
        raise argparse.ArgumentTypeError(f"expected at most {MAX_EPISODES:,} seeds, found '{text}'")
    return range(lowest, highest + 1)


def shard_argument(text: str) -> Shard:
    """Read the value of `--shard`."""
    try:
        return Shard.parse(text)
    except RecipeError as exc:
        raise argparse.ArgumentTypeError(str(exc)) from exc


def add_shard(parser: argparse.ArgumentParser) -> None:
    """Declare `--shard I/N`."""
    parser.add_argument(
        "--shard",
        type=shard_argument,
        metavar="I/N",
        help="run only part I of N, to OUT-shard-I-of-N; `mikasa-vla merge` puts them together",
    )


def descriptor_argument(text: str) -> int:
    """Read the number of an open file descriptor that is none of input and results."""
    try:
        descriptor = int(text)
        if descriptor < 2:
            raise ValueError
        os.fstat(descriptor)
    except (ValueError, OverflowError, OSError) as exc:
        raise argparse.ArgumentTypeError(
            f"expected the number of an open file descriptor, 2 (standard error) or above, found '{text}'. "
            "For a file: --json-progress 3 3>FILE"
        ) from exc
    return descriptor


def add_json_progress(parser: argparse.ArgumentParser) -> None:
    """Declare `--json-progress FD`."""
    parser.add_argument(
        "--json-progress",
        type=descriptor_argument,
        metavar="FD",
        help="also write progress as JSON lines to this file descriptor; 2: in place of the bar",
    )


def set_flags(data: dict[str, Any], args: argparse.Namespace, names: Sequence[str]) -> None:  # Any: YAML
    """Set the fields of a recipe whose flags were given."""
    data.update({name: value for name in names if (value := getattr(args, name)) is not None})


def add_overrides(parser: argparse.ArgumentParser, *, help: str) -> None:
    """Declare `--set A.B=C`, as often as one likes."""
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="A.B=C", help=help)


def add_dry_run(parser: argparse.ArgumentParser) -> None:
    """Declare `--dry-run`; what it assumes are flags of each verb."""
    parser.add_argument(
        "--dry-run", action="store_true", help="show what would run and what it takes; run nothing"
    )


def positive_argument(text: str) -> float:
    """Read a number above zero."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found '{text}'")
    return number


def memory_argument(text: str) -> float:
    """Read a size of memory, `80GB` or `80GiB`, in bytes."""
    for unit, n_bytes in (("GiB", 1 << 30), ("GB", 10**9)):
        if text.endswith(unit):
            return positive_argument(text.removesuffix(unit)) * n_bytes
    raise argparse.ArgumentTypeError(f"expected a size such as 80GB or 80GiB, found '{text}'")


def add_old_flag(
    parser: argparse.ArgumentParser,
    old: str,
    new: str,
    *,
    kind: Callable[[str], Any] = str,  # Any: what the flag's values are read as
    nargs: str | None = None,
) -> None:
    """Let a flag also be typed by its old name, which no help shows.

    Args:
        parser: has the new flag already.
        old: `--record-video`.
        new: `--capture-video`.
        kind: argparse's `type`, as the new flag has it.
        nargs: argparse's, as the new flag has it.
    """
    parser.add_argument(
        old,
        dest=new.removeprefix("--").replace("-", "_"),
        action=_OldFlag,
        type=kind,
        nargs=nargs,
        help=argparse.SUPPRESS,
        const=new,
    )


class _OldFlag(argparse.Action):
    """Stores the value as the new flag does, and warns; `const` is the new flag."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,  # Any: argparse's own annotation
        option_string: str | None = None,
    ) -> None:
        """Store and warn."""
        warn_renamed(str(option_string), self.const)
        setattr(namespace, self.dest, values)
