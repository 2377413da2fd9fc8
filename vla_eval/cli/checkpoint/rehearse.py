"""`mikasa-vla checkpoint rehearse`: what `checkpoint` does with a recipe's true size and random weights."""

import argparse
import json
from pathlib import Path
from typing import Any

REHEARSE = "rehearse"
DESCRIPTION = """Build a recipe's policy at its published size with random weights, write it as a checkpoint,
load it strictly, and let it act for 20 control steps on a fake simulator. Prints parameters, bytes,
seconds and peak memory. The checkpoint is removed afterwards. With the folder of a checkpoint or a run, that
is loaded instead, and nothing is written."""


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    sub = actions.add_parser(
        REHEARSE,
        help="try a recipe at its true size, with random weights",
        description=DESCRIPTION,
        allow_abbrev=False,
    )
    sub.add_argument(
        "name",
        metavar="RECIPE|DIR",
        help="in policies/, with a `finetune` section; or a folder of a LeRobot checkpoint",
    )
    sub.add_argument("--dtype", choices=("float32", "bfloat16"), help="precision (the recipe's)")
    sub.add_argument("--device", default="auto", metavar="D", help="auto, cpu, cuda (auto)")
    sub.add_argument(
        "--out", type=Path, default=Path("rehearsal"), metavar="DIR", help="folder to use (rehearsal)"
    )
    sub.add_argument("--format", choices=("text", "json"), default="text", help="of the output (text)")
    sub.add_argument("--tiny", action="store_true", help="tiny networks, to try the command itself")


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.policies.lerobot.device import choose_device
    from vla_eval.testing.rehearsal import RehearsalOptions, rehearse, rehearse_checkpoint

    options = RehearsalOptions(
        folder=args.out, dtype=args.dtype, device=choose_device(args.device), tiny=args.tiny
    )
    path = Path(args.name)
    found = rehearse_checkpoint(path, options) if path.is_dir() else rehearse(args.name, options)
    return [json.dumps(found.data(), indent=2)] if args.format == "json" else found.lines()
