"""`mikasa-vla checkpoint convert-spatialvla`: what `checkpoint` does for SpatialVLA."""

import argparse
from pathlib import Path
from typing import Any

from vla_eval.cli.shared.arguments import add_old_flag

CONVERT = "convert-spatialvla"


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    convert = actions.add_parser(CONVERT, help="make a LeRobot checkpoint of it", allow_abbrev=False)
    convert.add_argument("path", metavar="PATH", help="folder of the published checkpoint")
    convert.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    convert.add_argument("--unnorm-key", metavar="NAME", help="whose statistics, where there are several")
    convert.add_argument("--images", nargs="+", metavar="FIELD", help="images that are read (the base's)")
    add_old_flag(convert, "--pictures", "--images", nargs="+")
    convert.add_argument(
        "--head", choices=("tied", "own"), help="Gemma's output matrix: its input's, or its own (as told)"
    )


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.checkpoints.conversion.spatialvla import ConvertOptions, convert_spatialvla

    named: dict[str, Any] = {"pictures": tuple(args.images)} if args.images else {}
    options = ConvertOptions(unnorm_key=args.unnorm_key, head=args.head, **named)
    return [str(convert_spatialvla(Path(args.path), Path(args.out), options))]
