"""`python -m vla_eval.policies.openvla`: convert a published checkpoint, or merge an adapter."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from vla_eval.errors import VlaEvalError
from vla_eval.policies.openvla.configuration_openvla import HEADS
from vla_eval.policies.openvla.convert import ConvertOptions, convert_openvla
from vla_eval.policies.openvla.merging import merge_adapter


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of the two; return the exit code."""
    args = _parser().parse_args(arguments)
    try:
        if args.action == "merge":
            out = merge_adapter(Path(args.path), Path(args.out), base_checkpoint=args.base_checkpoint)
        else:
            out = convert_openvla(Path(args.path), Path(args.out), _options(args))
    except VlaEvalError as exc:
        sys.stderr.write(f"error: {exc}\n")
        return 1
    sys.stdout.write(f"{out}\n")
    return 0


def _options(args: argparse.Namespace) -> ConvertOptions:
    return ConvertOptions(
        head=args.head,
        chunk_size=args.chunk,
        unnorm_key=args.unnorm_key,
        proprio=args.proprio,
        allow_pickled=args.allow_pickled,
        gripper=args.gripper,
        **({"pictures": tuple(args.pictures)} if args.pictures else {}),
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m vla_eval.policies.openvla", allow_abbrev=False)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    convert = actions.add_parser("convert", help="make a LeRobot checkpoint of a published one")
    convert.add_argument("--head", choices=HEADS, default="tokens", help="tokens: a plain OpenVLA")
    convert.add_argument("--chunk", type=int, default=1, metavar="K", help="actions of a chunk")
    convert.add_argument("--unnorm-key", metavar="NAME", help="whose statistics, if there are several")
    convert.add_argument("--proprio", type=int, default=0, metavar="N", help="numbers of proprioception")
    convert.add_argument("--pictures", nargs="+", metavar="FIELD", help="fields of the pictures, in order")
    convert.add_argument("--gripper", default="maniskill", metavar="NAME", help="its encoding (maniskill)")
    convert.add_argument("--allow-pickled", action="store_true", help="read heads that are pickled tensors")
    merge = actions.add_parser("merge", help="merge a LoRA adapter into its base")
    merge.add_argument("--base-checkpoint", metavar="DIR", help="where the base lies, if it was moved")
    for action in (convert, merge):
        action.add_argument("path", metavar="PATH", help="what to read")
        action.add_argument("out", metavar="OUT", help="a new folder")
    return parser


if __name__ == "__main__":
    sys.exit(main())
