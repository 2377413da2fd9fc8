"""`mikasa-vla checkpoint merge`: put a LoRA adapter into its base."""

import argparse
from pathlib import Path
from typing import Any


def add_parsers(actions: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    merge = actions.add_parser("merge", help="put a LoRA adapter into its base", allow_abbrev=False)
    merge.add_argument("path", metavar="PATH", help="the adapter's checkpoint, or a run of ours")
    merge.add_argument("--out", metavar="DIR", required=True, help="folder to write")
    merge.add_argument("--base-checkpoint", metavar="DIR", help="folder of the base, if it was moved")


def run(args: argparse.Namespace) -> list[str]:
    """Do it; return lines for standard output."""
    # Here and not above: `mikasa-vla --help` need not wait for torch.
    from vla_eval.checkpoints.merging import merge_adapter

    return [str(merge_adapter(Path(args.path), Path(args.out), base_checkpoint=args.base_checkpoint))]
