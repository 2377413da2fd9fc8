"""`mikasa-vla view`: open captured episodes of a run, or episodes of a dataset, in the rerun viewer."""

import argparse
import hashlib
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from vla_eval.cli.shared.arguments import NUMBERS, task_argument
from vla_eval.errors import MissingDependencyError, ViewingError
from vla_eval.lock.switch import own_need

DESCRIPTION = """Open the episodes of RUN that `mikasa-vla eval --capture-rrd …` captured in the rerun viewer.

RUN may also be a dataset (OUT/TASK of `mikasa-vla record`, or any LeRobotDataset v3): its episodes are shown.
Without a choice, the first five are opened. On a machine without a screen, --web serves the viewer to a
browser, and --print names the files, to be copied to a machine with one (`rerun FILE…` opens them)."""
RUN_FLAGS = {"--task": "task", "--policy": "policy", "--n-action-steps": "n_action_steps"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "docs/captures.md says what is in the files."
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder (runs/…), or a dataset")
    parser.add_argument("--seed", type=int, metavar="S", help="only this seed")
    parser.add_argument("--task", type=task_argument, metavar="T", help="only this task")
    parser.add_argument("--policy", metavar="P", help="only this policy")
    parser.add_argument("--n-action-steps", type=int, metavar="K", help="only this K")
    parser.add_argument("--episode", **NUMBERS, metavar="I", help="of a dataset: only these numbers")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--web", action="store_true", help="serve the viewer to a browser")
    how.add_argument("--print", action="store_true", help="print the paths of the files, open nothing")


def run(args: argparse.Namespace) -> int:
    """Find the rerun files and open them."""
    from vla_eval.data.info_file import one_dataset
    from vla_eval.storage.folders import kind_of
    from vla_eval.viz.picking import MOST_OPENED
    from vla_eval.workers.children import bound_command

    if kind_of(args.run) is None and args.run.is_dir():
        args.run = one_dataset(args.run)
    if kind_of(args.run) == "dataset":
        _check_screen(args)  # before episodes are decoded and written
        found = _of_dataset(args)
    else:
        found = _of_run(args)
        _check_screen(args)
    if args.print:
        print("\n".join(map(str, found)))
        return 0
    if len(found) > MOST_OPENED:
        print(
            f"{len(found)} rerun files; opening the first {MOST_OPENED}. --seed picks one.", file=sys.stderr
        )
    command = bound_command(_viewer(), *map(str, found[:MOST_OPENED]))
    with own_need():
        return subprocess.run([*command, "--web-viewer"] if args.web else command, check=False).returncode


def _viewer() -> str:
    """Return the viewer's program, which `python -m rerun` starts: a child of it would outlive us."""
    if named := os.environ.get("RERUN_CLI_PATH"):  # rerun's own variable
        return named
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise MissingDependencyError("expected the viewer of rerun-sdk, found none. Run `make setup` again.")
    return str(Path(package.origin).with_name("rerun"))


def _of_run(args: argparse.Namespace) -> list[Path]:
    from vla_eval.storage.run_folder import read_run
    from vla_eval.viz.picking import pick

    if args.episode is not None:
        raise ViewingError(f"{args.run}: is a run; --episode is of datasets. --seed picks one of a run.")
    wished = {name: getattr(args, name) for name in ("task", "policy", "n_action_steps", "seed")}
    return pick(read_run(args.run), **wished)


def _of_dataset(args: argparse.Namespace) -> list[Path]:
    """Write the episodes into the user's cache, from where the viewer opens them."""
    from vla_eval.data.sharing.rrd import EpisodeWish, write_dataset_rrds
    from vla_eval.storage.cache import cached
    from vla_eval.viz.picking import MOST_OPENED

    given = [flag for flag, name in RUN_FLAGS.items() if getattr(args, name) is not None]
    if given:
        raise ViewingError(
            f"{args.run}: is a dataset; {', '.join(given)} is of runs. Use --episode or --seed."
        )
    wish = EpisodeWish(episodes=tuple(args.episode or ()), seed=args.seed, most=MOST_OPENED)
    return write_dataset_rrds(args.run, wish, cached(f"rrd/{cache_place(args.run)}"))


def cache_place(dataset: Path) -> str:
    """Return a name for the rerun files of a dataset: datasets of one name in two folders have two."""
    folder = dataset.resolve()
    return f"{folder.name}-{hashlib.sha256(os.fsencode(folder)).hexdigest()[:12]}"


def _check_screen(args: argparse.Namespace) -> None:
    is_linux = sys.platform == "linux"
    has_screen = not is_linux or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not args.print and not args.web and not has_screen:
        raise ViewingError(
            "There is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set). Use --web to look with a "
            "browser, or --print and open the files on another machine."
        )
