"""`mikasa-vla replay`: run a dataset's episodes again and compare, or rebuild it from its manifest."""

import argparse
import sys
from contextlib import closing
from pathlib import Path

from vla_eval.cli.shared.arguments import NUMBERS, add_flags
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.cli.shared.replaying import replay_each
from vla_eval.errors import RecipeError
from vla_eval.workers.needed_files import shared_folder

DESCRIPTION = """Execute the stored actions of a dataset in the simulator; compare states and success, and
with --pixels images. One line per mismatch. The result of a whole dataset is kept in it, and training
refuses a dataset whose replay has failed.

DATASET is the folder of one dataset, or one that holds some (OUT of `mikasa-vla record`)."""
EPILOG = "exit codes: 0 no mismatch; 1 a mismatch, or a mistake; 130, 143 stopped by Ctrl-C, SIGTERM."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of a dataset, or of some")
    parser.add_argument("--episodes", **NUMBERS, metavar="N", help="only these (default: all)")
    parser.add_argument("--pixels", action="store_true", help="render, and compare images and video, too")
    add_flags(parser, "--workers", "--cluster", "--json-progress")
    parser.set_defaults(workers="auto")
    parser.add_argument(
        "--rebuild",
        type=Path,
        metavar="OUT",
        help="do not compare: rebuild the dataset in OUT, from its manifest alone",
    )


def run(args: argparse.Namespace) -> int:
    """Replay; mismatches and summaries go to standard output, progress to standard error."""
    if args.rebuild is not None:
        return _rebuild(args)
    from vla_eval.cli.terminal.progress import RecordingProgress, stop_on_signals
    from vla_eval.data.replaying.replay import find_datasets

    needs = (shared_folder(args.dataset),)
    with backend_of(args, needs=lambda: needs) as backend, stop_on_signals() as stop:
        return replay_each(
            find_datasets(args.dataset),
            stop,
            RecordingProgress(stop, json_progress=args.json_progress),
            episodes=args.episodes,
            pixels=args.pixels,
            workers=args.workers,
            backend=backend,
        )


def _rebuild(args: argparse.Namespace) -> int:
    from vla_eval.cli.record import describe as describe_dataset
    from vla_eval.cli.terminal.progress import RecordingProgress, stop_on_signals
    from vla_eval.data.derived.rebuild import rebuild

    if args.episodes is not None or args.pixels:
        raise RecipeError(
            "--rebuild makes the whole dataset again: it does not go with --episodes or --pixels."
        )
    needs = (shared_folder(args.rebuild),)
    with (
        backend_of(args, needs=lambda: needs) as backend,
        stop_on_signals() as stop,
        closing(RecordingProgress(stop, json_progress=args.json_progress)) as progress,
    ):
        rebuilt = rebuild(
            args.dataset, out=args.rebuild, workers=args.workers, observer=progress, backend=backend
        )
    if rebuilt is None:
        print("Stopped. The same command resumes.", file=sys.stderr)
        return stop.exit_code
    print(describe_dataset(rebuilt.dataset))
    print(
        f"episodes whose raw images are those that were recorded: {rebuilt.n_same_images} "
        f"of {rebuilt.dataset.facts.n_episodes}"
    )
    return 0
