"""`mikasa-vla view`: open recorded episodes of a run in the rerun viewer."""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

DESCRIPTION = """Open the episodes of RUN that `mikasa-vla eval --record-rrd …` recorded in the rerun viewer.

Without a choice, the first five are opened. On a machine without a screen, --web serves the viewer to a
browser, and --print names the files, to be copied to a machine with one (`rerun FILE…` opens them)."""
DATASET_FILE = Path("meta") / "info.json"


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:  # Any: the parser class is main's
    """Declare the arguments."""
    parser = subparsers.add_parser(
        "view",
        help="open recorded episodes in the rerun viewer",
        description=DESCRIPTION,
        epilog="docs/recordings.md says what is in a recording.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder (runs/…)")
    parser.add_argument("--seed", type=int, metavar="S", help="only this seed")
    parser.add_argument("--task", metavar="T", help="only this task")
    parser.add_argument("--policy", metavar="P", help="only this policy")
    parser.add_argument("--n-action-steps", type=int, metavar="K", help="only this K")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve the viewer to a browser")
    how.add_argument("--print", action="store_true", help="print the paths of the files, open nothing")


def run(args: argparse.Namespace) -> int:
    """Find the recordings and open them.

    Raises:
        VlaEvalError: RUN is no run folder, holds no such recording, or there is no screen.
    """
    # Here and not above: `mikasa-vla --help` need not wait for them.
    from vla_eval.errors import ViewingError
    from vla_eval.results.store import read_run
    from vla_eval.viz.picking import MOST_OPENED, Wish, pick

    if (args.run / DATASET_FILE).is_file():
        raise ViewingError(
            f"{args.run}: is a dataset, not a run. LeRobot's own viewer shows it: lerobot-dataset-viz "
            f"--repo-id {args.run.name} --root {args.run} --episode-index 0"
        )
    wish = Wish(task=args.task, policy=args.policy, n_action_steps=args.n_action_steps, seed=args.seed)
    found = pick(read_run(args.run), wish)
    if args.print:
        print("\n".join(map(str, found)))
        return 0
    if not args.web and not _has_screen():
        raise ViewingError(
            "There is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set). Use --web to look with a "
            "browser, or --print and open the files on another machine."
        )
    if len(found) > MOST_OPENED:
        print(f"{len(found)} recordings; opening the first {MOST_OPENED}. --seed picks one.", file=sys.stderr)
    command = [sys.executable, "-m", "rerun", *map(str, found[:MOST_OPENED])]
    return subprocess.run([*command, "--web-viewer"] if args.web else command, check=False).returncode


def _has_screen() -> bool:
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
