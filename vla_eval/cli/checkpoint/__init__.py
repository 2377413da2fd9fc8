"""`mikasa-vla checkpoint`: check that a checkpoint is complete, or convert an original one."""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import Any

from vla_eval.cli.checkpoint import fetch as checkpoint_fetch
from vla_eval.cli.checkpoint import openvla as checkpoint_openvla
from vla_eval.cli.checkpoint import rehearse as checkpoint_rehearse
from vla_eval.cli.checkpoint import spatialvla as checkpoint_spatialvla
from vla_eval.cli.checkpoint.arguments import add_gripper
from vla_eval.cli.shared.arguments import add_verb

DESCRIPTION = """verify: load a LeRobot checkpoint strictly (every tensor, shape and type), look for its
statistics, and let it act once. It says nothing of how good the policy is.
fetch: get a published base from the Hub, check it, and convert it where needed.
rehearse: try a recipe at its true size with random weights.
convert-octo, convert-openvla, convert-spatialvla: make a LeRobot checkpoint of an original one. merge: put a
LoRA adapter into its base. Only fetch downloads anything."""


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    parser = add_verb(
        subparsers,
        "checkpoint",
        help="check a checkpoint, or convert an original one",
        description=DESCRIPTION,
        epilog="docs/octo.md, docs/openvla.md and docs/spatialvla.md explain converting.",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    verify = actions.add_parser("verify", help="load it strictly and let it act once", allow_abbrev=False)
    verify.add_argument("path", metavar="PATH", help="a LeRobot checkpoint, or a run of ours")
    verify.add_argument("--device", default="cpu", metavar="D", help="auto, cpu, cuda (cpu)")
    convert = actions.add_parser("convert-octo", help="make a LeRobot checkpoint of it", allow_abbrev=False)
    convert.add_argument("path", metavar="PATH", help="folder of the original checkpoint")
    convert.add_argument("--size", choices=("small", "base"), required=True, help="which Octo it is")
    convert.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    convert.add_argument("--dataset-name", metavar="NAME", help="whose statistics, where there are several")
    add_gripper(convert)
    checkpoint_fetch.add_parsers(actions)
    checkpoint_openvla.add_parsers(actions)
    checkpoint_spatialvla.add_parsers(actions)
    checkpoint_rehearse.add_parsers(actions)
    for sub in (verify, convert):
        sub.add_argument("--tokenizer", metavar="DIR", help="folder of the tokenizer")


def run(args: argparse.Namespace) -> int:
    """Do it; the result goes to standard output."""
    with contextlib.redirect_stdout(sys.stderr):  # some policies print while they are made
        if args.action == checkpoint_fetch.FETCH:
            lines = checkpoint_fetch.run(args)
        elif args.action == checkpoint_rehearse.REHEARSE:
            lines = checkpoint_rehearse.run(args)
        elif args.action in (checkpoint_openvla.CONVERT, checkpoint_openvla.MERGE):
            lines = checkpoint_openvla.run(args)
        elif args.action == checkpoint_spatialvla.CONVERT:
            lines = checkpoint_spatialvla.run(args)
        else:
            lines = _verify(args) if args.action == "verify" else _convert(args)
    print("\n".join(lines))
    return 0


def _verify(args: argparse.Namespace) -> list[str]:
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.checkpoints.loading import LoadOptions
    from vla_eval.checkpoints.verify import verify_checkpoint
    from vla_eval.policies.lerobot.device import choose_device

    options = LoadOptions(device=choose_device(args.device), tokenizer=args.tokenizer)
    return verify_checkpoint(Path(args.path), options).lines()


def _convert(args: argparse.Namespace) -> list[str]:
    from vla_eval.checkpoints.conversion.octo import SIZES, convert

    out = convert(
        Path(args.path),
        Path(args.out),
        fields=SIZES[args.size],
        dataset=args.dataset_name,
        gripper=args.gripper,
        tokenizer=args.tokenizer,
    )
    return [str(out)]
