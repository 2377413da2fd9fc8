"""Shared by several verbs: kinds of arguments, exit codes, the typed command."""

import argparse
import contextlib
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.slips import Several, numbers
from vla_eval.config.files import Folder
from vla_eval.errors import RecipeError, check_names
from vla_eval.results.formats import FORMATS
from vla_eval.storage.shard import Shard
from vla_eval.strict.bounds import MAX_EPISODES, check_seeds
from vla_eval.strict.decoding import warn_renamed

if TYPE_CHECKING:
    from vla_eval.training.dry_run import DryRunOptions

EXIT_EPISODE_ERRORS = 3
"""All episodes were run, and some ended in an error."""


def typed_command() -> str:
    """Return the command that is running, as a shell takes it."""
    return shlex.join(["mikasa-vla", *sys.argv[1:]])


@contextlib.contextmanager
def dry_run_options(args: argparse.Namespace) -> "Iterator[DryRunOptions]":
    """Give what `finetune --dry-run` assumes; where a base is missing, networks of the published sizes."""
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


def set_flags(data: dict[str, Any], args: argparse.Namespace, names: Sequence[str]) -> None:  # Any: YAML
    """Set the fields of a recipe whose flags were given."""
    data.update({name: value for name in names if (value := getattr(args, name)) is not None})


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


def env_paths(overrides: Sequence[str]) -> dict[str, list[str]]:
    """Return `delay_steps` -> `env.delay_steps` of all arguments of tasks, for messages about `--set`."""
    if not overrides:
        return {}
    from vla_eval.tasks.catalog import TASKS
    from vla_eval.tasks.source import task_arguments

    names = [
        *("horizon_steps", "robot"),
        *(one.name for task in TASKS.values() for one in task_arguments(task.entry_point)),
    ]
    return {name: [f"env.{name}"] for name in names}


def task_argument(text: str) -> str:
    """Read the id of a task; without its version, it is the only one that there is."""
    from vla_eval.tasks.catalog import with_version

    return with_version(text)


def suite_tasks(name: str) -> tuple[str, ...]:
    """Return the tasks of a suite; say on standard error which are left out, as they take hours."""
    from vla_eval.tasks.catalog import SUITES

    check_names("suite", [name], SUITES, where="--suite")
    specs = next(rows for suite, rows in SUITES.items() if suite == name).values()
    slow = [spec.id for spec in specs if spec.is_slow]
    if slow:
        print(
            f"left out of --suite {name}, as 100 episodes take an hour: {', '.join(slow)}. Run them apart, "
            "with --task and fewer --episodes.",
            file=sys.stderr,
        )
    return tuple(spec.id for spec in specs if not spec.is_slow)


MANY: Mapping[str, Any] = {"nargs": "+", "action": Several}
NUMBERS: Mapping[str, Any] = {**MANY, "type": numbers}
FLAGS: Mapping[str, Mapping[str, Any]] = {
    "--task": {**MANY, "type": task_argument, "dest": "tasks", "metavar": "T", "help": "task ids"},
    "--policy": {**MANY, "dest": "policies", "metavar": "P", "help": "names, files or folders"},
    "--n-action-steps": {**NUMBERS, "metavar": "K", "help": "actions per inference"},
    "--episodes": {"type": int, "metavar": "N"},
    "--seed-start": {"type": int, "metavar": "S", "help": "seed of the first episode (1)"},
    "--workers": {"type": workers_argument, "metavar": "W", "help": "processes, or 'auto': one per core"},
    "--cluster": {
        "metavar": "WHERE",
        "help": "run on a Ray cluster: auto, local or ray://HOST:PORT (docs/cluster.md)",
    },
    "--out": {"type": Path, "metavar": "DIR"},
    "--shard": {
        "type": shard_argument,
        "metavar": "I/N",
        "help": "run only part I of N, to OUT-shard-I-of-N; `mikasa-vla merge` puts them together",
    },
    "--json-progress": {
        "type": descriptor_argument,
        "metavar": "FD",
        "help": "also write progress as JSON lines to this file descriptor; 2: in place of the bar",
    },
    "--set": {"action": "append", "default": [], "dest": "overrides", "metavar": "A.B=C"},
    "--dry-run": {"action": "store_true", "help": "show what would run and what it takes; run nothing"},
    "--allow-environment-change": {
        "action": "store_true",
        "help": "resume although package versions or the machine have changed",
    },
    "--format": {"choices": FORMATS, "default": "markdown", "help": "(markdown)"},
}
"""What argparse takes of the flags that several verbs have; without a help, each says its own."""


def add_flags(parser: argparse.ArgumentParser, *flags: str, **own_helps: str) -> None:
    """Declare flags of the table, those with a help of the verb's own by their names (`seed_start="…"`)."""
    helps = {flag: FLAGS[flag].get("help") for flag in flags}
    helps |= {f"--{name.replace('_', '-')}": text for name, text in own_helps.items()}
    for flag, text in helps.items():
        parser.add_argument(flag, **{**FLAGS[flag], "help": text})


def read_config[T](
    cls: type[T],
    edit: Callable[[dict[str, Any]], None],  # Any: plain data of YAML
    *,
    folder: Folder,
    name: str | None,
    start: Mapping[str, Any],
    asks: str,
    needed: Mapping[str, str],
    example: str,
) -> T:
    """Return a configuration: the file `name`, or the fields `start` in its place, with the flags on top.

    Without a file, a field of `needed` that is missing is refused with its flag, `asks` and an `example`.
    """
    from vla_eval.tasks.configured import read_configured

    def check(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        for field, flag in needed.items():
            if field not in data:
                raise RecipeError(f"Name {asks}; {flag} is missing. Example: mikasa-vla {example}")

    return read_configured(
        cls, name, folder=folder, start=start, edit=edit, check=check, where="command line"
    )


def api_key_of(args: argparse.Namespace) -> str | None:
    """Return the key that the environment variable of `--api-key-env` holds; None without the flag."""
    if args.api_key_env is None:
        return None
    if key := os.environ.get(args.api_key_env):
        return key
    raise RecipeError(
        f"--api-key-env {args.api_key_env}: expected a key in this variable, but the variable "
        f"'{args.api_key_env}' is not set. Put the server's key into it."
    )


def add_old_flag(
    parser: argparse.ArgumentParser,
    old: str,
    new: str,
    *,
    kind: Callable[[str], Any] = str,  # Any: what the flag's values are read as
    nargs: str | None = None,
) -> None:
    """Let a flag, which the parser has, also be typed by its old name, which no help shows."""
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
        warn_renamed(str(option_string), self.const)
        setattr(namespace, self.dest, values)
