"""`mikasa-vla checkpoint`: check that a checkpoint is complete, or convert an original one."""

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from vla_eval.cli.shared.arguments import MANY, add_old_flag
from vla_eval.errors import MAX_SHOWN, CheckpointError
from vla_eval.models.families import FAMILIES, bases
from vla_eval.models.family import Family, imported
from vla_eval.models.shared.options import Flag, flags_of
from vla_eval.strict.devices import check_device

DESCRIPTION = """verify: load a LeRobot checkpoint strictly (every tensor, shape and type), look for its
statistics, and let it act once. It says nothing of how good the policy is.
fetch: get a published base from the Hub, check it, and convert it where needed.
rehearse: try a recipe at its true size with random weights.
{}: make a LeRobot checkpoint of an original one. merge: put a
LoRA adapter into its base. Only fetch downloads anything."""
FETCH = """Fetch a published checkpoint that recipes start from, check every file, and convert it where
needed. It shows the licence, and the size and the free disk, before it fetches. The same command again
resumes, or checks what is there. Names: """
REHEARSE = """Build a recipe's policy at its published size with random weights, write it as a checkpoint,
load it strictly, and let it act for 20 control steps on a fake simulator. Prints parameters, bytes,
seconds and peak memory. The checkpoint is removed afterwards. With the folder of a checkpoint or a run, that
is loaded instead, and nothing is written."""


def _converted() -> dict[str, Family]:
    """Return action -> the family whose published checkpoints it converts."""
    return {f"convert-{family.name}": family for family in FAMILIES.values() if family.converter}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    pages = [family.docs for family in _converted().values()]
    parser.description = DESCRIPTION.format(", ".join(_converted()))
    parser.epilog = f"{', '.join(pages[:-1])} and {pages[-1]} explain converting."
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="load it strictly and let it act once", allow_abbrev=False)
    verify.add_argument("path", metavar="PATH", help="a LeRobot checkpoint, or a run of ours")
    verify.add_argument("--device", type=check_device, default="cpu", metavar="D", help="auto, cuda (cpu)")
    verify.add_argument("--tokenizer", metavar="DIR", help="folder of the tokenizer")
    verify.add_argument("--verbose", action="store_true", help="name each statistic, not only their fields")
    for add in (_add_convert, _add_fetch, _add_merge, _add_rehearse):
        add(actions)


def _add_convert(actions: "argparse._SubParsersAction[Any]") -> None:
    for verb, family in _converted().items():
        convert = actions.add_parser(verb, help="make a LeRobot checkpoint of it", allow_abbrev=False)
        convert.add_argument("path", metavar="PATH", help="folder of the published checkpoint")
        convert.add_argument("--out", metavar="DIR", required=True, help="folder to write")
        for flag in flags_of(imported(family.convert_options)).values():
            choices = {"choices": tuple(flag.values)} if flag.values else {}
            several = MANY if "nargs" in flag.settings else {}
            convert.add_argument(flag.name, **choices, **{**several, **flag.settings})
            if flag.former:
                add_old_flag(convert, flag.former, flag.name, nargs=flag.settings.get("nargs"))


def _add_fetch(actions: "argparse._SubParsersAction[Any]") -> None:
    fetch = actions.add_parser(
        "fetch",
        help="get a published base from the Hub",
        description=f"{FETCH}{', '.join(bases())}.",
        allow_abbrev=False,
    )
    fetch.add_argument(
        "name", metavar="NAME", help="of a base, of a recipe that starts from it, or hub:OWNER/NAME@REVISION"
    )
    fetch.add_argument("--out", type=Path, metavar="DIR", help="folder to make (checkpoints/NAME)")
    fetch.add_argument("--revision", metavar="REV", help="branch, tag or commit (the pinned one)")


def _add_merge(actions: "argparse._SubParsersAction[Any]") -> None:
    merge = actions.add_parser("merge", help="put a LoRA adapter into its base", allow_abbrev=False)
    merge.add_argument("path", metavar="PATH", help="the adapter's checkpoint, or a run of ours")
    merge.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    merge.add_argument("--base-checkpoint", metavar="DIR", help="folder of the base, if it was moved")


def _add_rehearse(actions: "argparse._SubParsersAction[Any]") -> None:
    sub = actions.add_parser(
        "rehearse",
        help="try a recipe at its true size, with random weights",
        description=REHEARSE,
        allow_abbrev=False,
    )
    sub.add_argument(
        "name",
        metavar="RECIPE|DIR",
        help="in policies/, with a `finetune` section; or a folder of a LeRobot checkpoint",
    )
    sub.add_argument("--dtype", choices=("float32", "bfloat16"), help="precision (the recipe's)")
    sub.add_argument("--device", type=check_device, default="auto", metavar="D", help="cpu, cuda (auto)")
    sub.add_argument(
        "--out", type=Path, default=Path("rehearsal"), metavar="DIR", help="folder to use (rehearsal)"
    )
    sub.add_argument("--format", choices=("text", "json"), default="text", help="of the output (text)")
    sub.add_argument("--tiny", action="store_true", help="tiny networks, to try the command itself")


def run(args: argparse.Namespace) -> int:
    """Do it; the result goes to standard output."""
    runs = {
        "verify": _verify,
        "fetch": _fetch,
        "rehearse": _rehearse,
        "merge": _merge,
        **dict.fromkeys(_converted(), _convert),
    }
    if args.action != "fetch":
        _look_for(args)
    with contextlib.redirect_stdout(sys.stderr):  # some policies print while they are made
        lines = runs[args.action](args)
    print("\n".join(lines))
    return 0


def _look_for(args: argparse.Namespace) -> None:
    """Look for what is named, before torch is loaded."""
    from vla_eval.checkpoints.files import find_checkpoint
    from vla_eval.config.finetuning import FinetuneConfig
    from vla_eval.training.request import load_finetune_recipe

    if args.action == "rehearse" and not os.path.isdir(args.name):
        load_finetune_recipe(FinetuneConfig(policy=args.name, dataset="none"))
    elif args.action in _converted():
        if not os.path.isdir(args.path):
            raise CheckpointError(
                f"{args.path:.{MAX_SHOWN}}: expected the folder of a published checkpoint, found no such "
                "folder. `mikasa-vla checkpoint fetch NAME` gets and converts a published base."
            )
    else:
        find_checkpoint(Path(args.name if args.action == "rehearse" else args.path))


def _verify(args: argparse.Namespace) -> list[str]:
    from vla_eval.checkpoints.loading import LoadOptions
    from vla_eval.checkpoints.verify import verify_checkpoint
    from vla_eval.policies.lerobot.device import choose_device

    options = LoadOptions(device=choose_device(args.device), tokenizer=args.tokenizer)
    return verify_checkpoint(Path(args.path), options).lines(verbose=args.verbose)


def _convert(args: argparse.Namespace) -> list[str]:
    from vla_eval.checkpoints.conversion import convert

    family = _converted()[args.action]
    options = imported(family.convert_options)
    given = {name: _value(args, flag) for name, flag in flags_of(options).items()}
    named = {name: value for name, value in given.items() if value is not None}
    return [str(convert(family.type, Path(args.path), Path(args.out), options(**named)))]


def _value(args: argparse.Namespace, flag: Flag) -> Any:
    value = getattr(args, flag.name.removeprefix("--").replace("-", "_"))
    if flag.values and value is not None:
        return flag.values[value]
    return tuple(value) if isinstance(value, list) else value


def _fetch(args: argparse.Namespace) -> list[str]:
    from vla_eval.checkpoints.bases import FOLDER, find_base
    from vla_eval.checkpoints.fetching import fetch_base
    from vla_eval.cli.shared.output import say

    base = find_base(args.name)
    out = args.out or FOLDER / base.name

    return [str(fetch_base(base, out, revision=args.revision, say=say))]


def _merge(args: argparse.Namespace) -> list[str]:
    from vla_eval.checkpoints.conversion import merge_adapter

    return [str(merge_adapter(Path(args.path), Path(args.out), base_checkpoint=args.base_checkpoint))]


def _rehearse(args: argparse.Namespace) -> list[str]:
    from vla_eval.policies.lerobot.device import choose_device
    from vla_eval.testing.rehearsal import RehearsalOptions, rehearse, rehearse_checkpoint

    options = RehearsalOptions(
        folder=args.out, dtype=args.dtype, device=choose_device(args.device), tiny=args.tiny
    )
    path = Path(args.name)
    found = rehearse_checkpoint(path, options) if path.is_dir() else rehearse(args.name, options)
    return [json.dumps(found.data(), indent=2)] if args.format == "json" else found.lines()
