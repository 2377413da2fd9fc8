"""`mikasa-vla merge`: put the shards of a run together."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS, FLAGS, add_flags
from vla_eval.errors import MergeError
from vla_eval.storage.folders import not_a_run_folder
from vla_eval.storage.run_file import RUN_FILE

if TYPE_CHECKING:
    from vla_eval.storage.merging import MergedRun

DESCRIPTION = """Put the shards of one run together, each made by the same command with another --shard.
The new folder holds what one run would have left: the same records, timings and captures. The shards stay
as they are.

Each RUN is the folder of a shard of `eval`, `audit`, `probe` or `record`. Shards of different plans, the same
shard twice, and missing shards or episodes are refused before anything is written."""
EPILOG = """exit codes: 0 merged; 1 a mistake, or something is missing (see the message); 3 merged, and some
episodes ended in an error (the command without --shard, with --out DIR, retries them)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a shard")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the new folder")
    parser.add_argument(
        "--allow-missing",
        action="store_true",
        help="merge what is there; the command without --shard, with --out DIR, runs the rest",
    )
    consequence = "; the table will say so"
    add_flags(parser, allow_environment_change=FLAGS["--allow-environment-change"]["help"] + consequence)


def run(args: argparse.Namespace) -> int:
    """Merge; the new run folders or datasets go to standard output, everything else to standard error."""
    from vla_eval.data.recording.folder import STATE_FOLDER

    recordings = [path for path in args.runs if (path / STATE_FOLDER / RUN_FILE).is_file()]
    if not recordings:
        return _merge_runs(args)
    others = [str(path) for path in args.runs if path not in recordings]
    if others:
        raise MergeError(f"{', '.join(others)}: expected a recording, as {recordings[0]} is, found none.")
    return _merge_recordings(args)


def _merge_runs(args: argparse.Namespace) -> int:
    from vla_eval.storage.merging import merge_runs, write_merged

    merged = {
        name: merge_runs(folders, allow_environment_change=args.allow_environment_change)
        for name, folders in _by_name(args.runs).items()
    }
    for name in merged:
        if (args.out / name).exists():
            raise MergeError(f"{args.out / name}: exists already. Name a new folder with --out.")
    _refuse_missing([line for one in merged.values() for line in one.missing], allowed=args.allow_missing)
    for name, one in merged.items():
        write_merged(one, args.out / name)
        print(describe(args.out / name, one))
    return EXIT_EPISODE_ERRORS if any(one.n_errors for one in merged.values()) else 0


def _merge_recordings(args: argparse.Namespace) -> int:
    from vla_eval.data.recording.merging import merge_recordings, write_recording

    merged = merge_recordings(args.runs, allow_environment_change=args.allow_environment_change)
    _refuse_missing(merged.missing, allowed=args.allow_missing)
    for facts in write_recording(merged, args.out):
        print(f"{args.out / facts.task}: {facts.n_episodes} episodes, {facts.n_frames} frames")
    return 0


def describe(folder: Path, merged: "MergedRun") -> str:
    """Return what was merged, in one line."""
    errors = f", {merged.n_errors} of them errors" if merged.n_errors else ""
    return f"{folder}: {len(merged.records)} episodes of {len(merged.runs)} shards{errors}"


def _by_name(runs: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the run folders that belong together, by name; that of a run folder itself is "."."""
    found: dict[str, list[Path]] = {}
    for path in runs:
        inside = sorted(file.parent.name for file in path.glob(f"*/{RUN_FILE}"))
        names = ["."] if (path / RUN_FILE).is_file() else inside
        if not names:
            raise not_a_run_folder(path)
        for name in names:
            found.setdefault(name, []).append(path / name)
    return found


def _refuse_missing(missing: Sequence[str], *, allowed: bool) -> None:
    if not missing:
        return
    listed = "\n".join(f"  {line}" for line in missing)
    if not allowed:
        raise MergeError(
            f"expected all shards of the run, each with all of its episodes; missing:\n{listed}\nRun what is "
            f"missing, or add --allow-missing. Nothing was written."
        )
    print(f"missing:\n{listed}", file=sys.stderr)
