"""The command `mikasa-vla`: find the verb, run it, turn a user's mistake into one message."""

import argparse
import errno
import importlib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn, Protocol, cast

from vla_eval import __version__
from vla_eval.cli.shared.slips import about_choice, about_empty, about_flag
from vla_eval.cli.terminal.streams import standard_streams
from vla_eval.errors import MAX_SHOWN, VlaEvalError
from vla_eval.lock.switch import OFF_VARIABLE, let_write, locked
from vla_eval.storage.starting import RUNS_FOLDER
from vla_eval.workers.children import leave_working_directory

PROGRAM = "mikasa-vla"
VERBS: Mapping[str, str] = {
    "init": "write a configuration with comments to start from",
    "eval": "run or resume an evaluation, and print its table",
    "report": "print the success table of run folders",
    "merge": "put the shards of a run together",
    "compare": "compare chunk lengths or policies with a reference",
    "reproduce": "find out whether a policy is as good as was claimed",
    "passport": "say how a figure was made, and whether two may be ranked",
    "check": "check whether a policy, or a policy server, keeps its contract",
    "audit": "find the tasks that can be won without memory",
    "probe": "find out what a policy remembers, and for how long",
    "real": "run the paper's three stages on a robot arm, or on a simulated one",
    "view": "open captured episodes, or a dataset's, in the rerun viewer",
    "record": "record demonstrations as LeRobot datasets, or resume recording",
    "replay": "check a dataset by running its episodes again",
    "dataset": "convert, mix, describe or share datasets",
    "finetune": "train a policy on a dataset, or resume the training",
    "train-agent": "train an agent by rewards or by imitation, or resume the training",
    "checkpoint": "check a checkpoint, or convert an original one",
    "serve": "serve a policy to simulators and other clients over WebSocket",
    "list": "list tasks, families, robots, policies, configs, prompts, datasets, protocols",
    "show": "explain a task, policy, configuration, dataset, protocol or folder",
    "doctor": "check this machine and say what to do",
    "bench": "measure rendering, loading or serving, as ratios from one run",
    "completion": "print the completion for a shell",
}
"""Verb -> its line in the help."""
FIRST_STEPS = f"""{PROGRAM} {__version__}: does a robot policy remember?

  {PROGRAM} eval demo
      scripted policies with and without memory on two tasks; minutes, no GPU
  {PROGRAM} check POLICY
      does it keep the contract? POLICY: a name, checkpoint or ws://HOST:PORT
  {PROGRAM} eval --task RememberColor3-v0 --policy POLICY cue_blind oracle
      your policy beside chance and ceiling, on the same episodes

`{PROGRAM} list` shows tasks and policies, `{PROGRAM} --help` every verb."""
PATHS_FAULT = {
    *(errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.ENOSPC, errno.EDQUOT, errno.EEXIST),  # the last: a file where a folder is to be
}
"""What the system says of a path that a user named, and not of a mistake of ours."""
_LONG_WORD = re.compile(rf"(\S{{{MAX_SHOWN}}})\S{{{MAX_SHOWN},}}")
EXIT_USER_MISTAKE = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells do it


class Verb(Protocol):
    """What the module of a verb offers."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the verb's arguments and texts; imports nothing heavy."""

    def run(self, args: argparse.Namespace) -> int:
        """Do it; returns the exit code."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one message and exits with 1, as all users' mistakes do."""

    def error(self, message: str) -> NoReturn:
        text = _with_short_words(message)
        self.exit(EXIT_USER_MISTAKE, f"{self.prog}: error: {text}\nSee `{self.prog} --help`.\n")

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Suggest a choice where argparse only lists them."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as exc:
            message = f"{exc.message}.{about_choice(value, action.choices or ())}"
            raise argparse.ArgumentError(action, message) from exc


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code; `argv` is without the program's name."""
    leave_working_directory()
    with standard_streams():
        return _run(list(sys.argv[1:] if argv is None else argv))


def _run(arguments: list[str]) -> int:
    if (nul := next((one for one in arguments if "\0" in one), None)) is not None:
        return _fail(_no_text(nul))
    if (empty := about_empty(arguments)) is not None:
        return _fail(empty)
    first = arguments[0] if arguments else ""
    if not arguments:
        print(FIRST_STEPS)
        return 0
    if not first.startswith("-") and first not in VERBS:
        suggestion = about_choice(first, (*VERBS, "--help", "--version")) or f" Known: {', '.join(VERBS)}."
        return _fail(f"there is no verb '{first}'.{suggestion} See `{PROGRAM} --help`.")
    parser = build_parser((first,) if first in VERBS else VERBS)
    try:
        args, unknown = parser.parse_known_args(arguments)
        if unknown:
            return _fail(_unknown_arguments(parser, first, unknown))
        if (no_text := next((one for one in _values(args) if not _is_text(one)), None)) is not None:
            return _fail(_no_text(no_text))
        if getattr(args, "no_lock", False):
            os.environ[OFF_VARIABLE] = "1"
        with locked():
            let_write(*_run_folders(), *_paths(args))
            code = _verb(args.verb).run(args)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has gone (`| head`)
        return 0
    except VlaEvalError as exc:
        return _fail(str(exc))
    except OSError as exc:
        if exc.filename is None or exc.errno not in PATHS_FAULT:
            raise
        return _fail(f"{exc.filename}: cannot be used: {exc.strerror}. Name another file or folder.")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return code


def _run_folders() -> Iterator[Path]:
    """Return where runs are written without --out, and what a user has linked into it from another disk."""
    yield RUNS_FOLDER
    if RUNS_FOLDER.is_dir() and os.access(RUNS_FOLDER, os.R_OK):
        with os.scandir(RUNS_FOLDER) as entries:  # which asks the disk once, however many runs there are
            yield from (Path(entry.path) for entry in entries if entry.is_symlink())


def build_parser(verbs: Iterable[str] = VERBS) -> argparse.ArgumentParser:
    """Return the parser of these verbs, whose modules are imported: a single one starts faster."""
    parser = _Parser(
        prog=PROGRAM,
        description="Evaluate vision-language-action policies on memory-intensive manipulation tasks.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    subparsers = parser.add_subparsers(dest="verb", metavar="VERB", title="verbs")
    for verb in verbs:
        # Texts are printed as they are written.
        form = argparse.RawDescriptionHelpFormatter
        below = subparsers.add_parser(verb, help=VERBS[verb], formatter_class=form, allow_abbrev=False)
        _verb(verb).add_arguments(below)
        _add_no_lock(below)
    return parser


def _add_no_lock(parser: argparse.ArgumentParser) -> None:
    """Add `--no-lock` to a verb, and to each of its actions."""
    parser.add_argument(
        "--no-lock",
        action="store_true",
        default=argparse.SUPPRESS,
        help="let what is read run programs and code (docs/security.md)",
    )
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _add_no_lock(below)


def _paths(args: argparse.Namespace) -> list[Path]:
    """Return what may be a file or a folder that the user named: it may be written to."""
    return [Path(one) for one in _values(args) if isinstance(one, str | Path) and one != ""]


def _verb(name: str) -> Verb:
    return cast(Verb, importlib.import_module(f"vla_eval.cli.{name.replace('-', '_')}"))


def _unknown_arguments(parser: argparse.ArgumentParser, verb: str, unknown: Sequence[str]) -> str:
    """Return what is wrong with arguments that no parser knows: the first flag, and the closest one."""
    flag = next((text.partition("=")[0] for text in unknown if text.startswith("-")), None)
    program = f"{PROGRAM} {verb}" if verb in VERBS else PROGRAM
    help_line = f" See `{program} --help`."
    if flag is None:
        return f"{verb}: expected no more arguments, found {' '.join(unknown)}.{help_line}"
    return f"{verb}: there is no flag '{flag}'.{about_flag(flag, flags_of(parser))}{help_line}"


def flags_of(parser: argparse.ArgumentParser) -> list[str]:
    """Return the long flags of a parser and of the verbs below it, but not those that no help shows."""
    flags: dict[str, None] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                flags.update(dict.fromkeys(flags_of(below)))
        elif action.help != argparse.SUPPRESS:
            flags.update(dict.fromkeys(text for text in action.option_strings if text.startswith("--")))
    return list(flags)


def _fail(message: str) -> int:
    print(f"{PROGRAM}: error: {_with_short_words(message)}", file=sys.stderr)
    return EXIT_USER_MISTAKE


def _no_text(argument: object) -> str:
    return f"expected text in UTF-8, found {argument!a:.{MAX_SHOWN}}. Correct the argument."


def _values(args: argparse.Namespace) -> Iterator[object]:
    for value in vars(args).values():
        yield from value if isinstance(value, list) else (value,)


def _is_text(value: object) -> bool:
    """Whether it can go into records and messages; the names of files and folders may be any bytes."""
    return not isinstance(value, str) or not any("\ud800" <= letter <= "\udfff" for letter in value)


def _with_short_words(message: str) -> str:
    """Return the message without the ends of words that fill a screen: what a user wrote, repeated."""
    return _LONG_WORD.sub(r"\1…", message)
