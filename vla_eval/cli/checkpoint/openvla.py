"""`mikasa-vla checkpoint convert-openvla` and `merge`: what `checkpoint` does for OpenVLA."""

import argparse
from pathlib import Path
from typing import Any, get_args

from vla_eval.cli.checkpoint.arguments import add_gripper
from vla_eval.cli.shared.arguments import add_old_flag
from vla_eval.models.openvla.sizes import Head

CONVERT, MERGE = "convert-openvla", "merge"


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    convert = actions.add_parser(CONVERT, help="make a LeRobot checkpoint of it", allow_abbrev=False)
    convert.add_argument("path", metavar="PATH", help="folder of the published checkpoint")
    convert.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    convert.add_argument("--head", choices=get_args(Head), default="tokens", help="tokens: a plain OpenVLA")
    convert.add_argument("--chunk", type=int, default=1, metavar="K", help="actions of a chunk (1)")
    convert.add_argument("--unnorm-key", metavar="NAME", help="whose statistics, where there are several")
    convert.add_argument("--image-aug", choices=("yes", "no"), help="trained with augmentation (as named)")
    convert.add_argument("--proprio", type=int, default=0, metavar="N", help="numbers of proprioception (0)")
    convert.add_argument("--images", nargs="+", metavar="FIELD", help="fields of the images, in order")
    add_old_flag(convert, "--pictures", "--images", nargs="+")
    add_gripper(convert)
    convert.add_argument("--allow-pickled", action="store_true", help="read heads that are pickled tensors")
    merge = actions.add_parser(MERGE, help="put a LoRA adapter into its base", allow_abbrev=False)
    merge.add_argument("path", metavar="PATH", help="the adapter's checkpoint, or a run of ours")
    merge.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    merge.add_argument("--base-checkpoint", metavar="DIR", help="folder of the base, if it was moved")


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    path, out = Path(args.path), Path(args.out)
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    if args.action == MERGE:
        from vla_eval.checkpoints.merging import merge_adapter

        return [str(merge_adapter(path, out, base_checkpoint=args.base_checkpoint))]
    from vla_eval.checkpoints.conversion.openvla import ConvertOptions, convert_openvla

    named: dict[str, Any] = {"pictures": tuple(args.images)} if args.images else {}
    options = ConvertOptions(
        head=args.head,
        chunk_size=args.chunk,
        unnorm_key=args.unnorm_key,
        gripper=args.gripper,
        image_augmentation=None if args.image_aug is None else args.image_aug == "yes",
        proprio=args.proprio,
        allow_pickled=args.allow_pickled,
        **named,
    )
    return [str(convert_openvla(path, out, options))]
