"""`mikasa-vla checkpoint`: check that a checkpoint is complete, or convert an original one."""

import argparse
import contextlib
import os
import sys
from pathlib import Path
from typing import Any

from vla_eval.cli.checkpoint import convert, fetch, merge, rehearse
from vla_eval.cli.shared.arguments import add_verb
from vla_eval.errors import MAX_SHOWN, CheckpointError

VERBS = ", ".join(convert.converted_families())
PAGES = [family.docs for family in convert.converted_families().values()]
DESCRIPTION = f"""verify: load a LeRobot checkpoint strictly (every tensor, shape and type), look for its
statistics, and let it act once. It says nothing of how good the policy is.
fetch: get a published base from the Hub, check it, and convert it where needed.
rehearse: try a recipe at its true size with random weights.
{VERBS}: make a LeRobot checkpoint of an original one. merge: put a
LoRA adapter into its base. Only fetch downloads anything."""


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    parser = add_verb(
        subparsers,
        "checkpoint",
        help="check a checkpoint, or convert an original one",
        description=DESCRIPTION,
        epilog=f"{', '.join(PAGES[:-1])} and {PAGES[-1]} explain converting.",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="load it strictly and let it act once", allow_abbrev=False)
    verify.add_argument("path", metavar="PATH", help="a LeRobot checkpoint, or a run of ours")
    verify.add_argument("--device", default="cpu", metavar="D", help="auto, cpu, cuda (cpu)")
    verify.add_argument("--tokenizer", metavar="DIR", help="folder of the tokenizer")
    verify.add_argument("--verbose", action="store_true", help="name each statistic, not only their fields")
    for module in (convert, fetch, merge, rehearse):
        module.add_parsers(actions)


def run(args: argparse.Namespace) -> int:
    """Do it; the result goes to standard output."""
    runs = {
        "verify": _verify,
        fetch.FETCH: fetch.run,
        rehearse.REHEARSE: rehearse.run,
        "merge": merge.run,
        **dict.fromkeys(convert.converted_families(), convert.run),
    }
    if args.action != fetch.FETCH:
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

    if args.action == rehearse.REHEARSE and not os.path.isdir(args.name):
        load_finetune_recipe(FinetuneConfig(policy=args.name, dataset="none"))
    elif args.action in convert.converted_families():
        if not os.path.isdir(args.path):
            raise CheckpointError(
                f"{args.path:.{MAX_SHOWN}}: expected the folder of a published checkpoint, found no such "
                "folder. `mikasa-vla checkpoint fetch NAME` gets and converts a published base."
            )
    else:
        find_checkpoint(Path(args.name if args.action == rehearse.REHEARSE else args.path))


def _verify(args: argparse.Namespace) -> list[str]:
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.checkpoints.loading import LoadOptions
    from vla_eval.checkpoints.verify import verify_checkpoint
    from vla_eval.policies.lerobot.device import choose_device

    options = LoadOptions(device=choose_device(args.device), tokenizer=args.tokenizer)
    return verify_checkpoint(Path(args.path), options).lines(verbose=args.verbose)
