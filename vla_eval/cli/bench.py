"""`mikasa-vla bench`: rendering, loading, and a policy behind a socket, as ratios from one run."""

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.cli.shared.arguments import MANY, NUMBERS, task_argument
from vla_eval.errors import MissingDependencyError
from vla_eval.strict.bounds import MAX_STEPS, check_bounds

if TYPE_CHECKING:
    from vla_eval.bench.serving_processes import Load

SYNTHETIC = "synthetic"
EAGER = ""  # the baseline of --against-official without an interpreter
SMALL = ""  # the policy of --serve that is made for it
MAX_REPEATS, MAX_BATCHES = 1000, 100_000
MAX_SESSIONS, MAX_SECONDS = 256, 3600
MAX_WORKERS, MAX_MEASURED_EPISODES = 256, 10_000
MIB = 2**20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the verb to the command line."""
    parser.add_argument(
        "--task", type=task_argument, default="RememberColor3-v0", help="task id (default: %(default)s)"
    )
    parser.add_argument("--n-action-steps", **NUMBERS, default=[1, 4, 8], metavar="K")
    parser.add_argument("--repeats", type=int, default=2, help="the lowest of so many times counts")
    parser.add_argument("--wrist-mesh", choices=("shipped", "whole", "simplified"), default="shipped")
    parser.add_argument(
        "--against-official",
        nargs="?",
        const=EAGER,
        metavar="PYTHON",
        help="instead: whole evaluations against the official runner, installed where this interpreter is, "
        "or against our own eager loop if none is named",
    )
    parser.add_argument(
        "--workers", type=int, default=2, metavar="N", help="with --against-official (default: %(default)s)"
    )
    parser.add_argument(
        "--episodes", type=int, default=48, metavar="N", help="with --against-official (default: %(default)s)"
    )
    parser.add_argument(
        "--baseline-episodes",
        type=int,
        default=6,
        metavar="N",
        help="of the official runner, the first one only for its start-up (default: %(default)s)",
    )
    parser.add_argument(
        "--loader",
        nargs="?",
        const=SYNTHETIC,
        metavar="DATASET",
        help="instead: samples per second of our loader and of LeRobot's, as trainings get them (of the fake "
        "simulator's demonstrations if no dataset is named)",
    )
    parser.add_argument(
        "--policy",
        **MANY,
        default=["act", "memory", "recurrent"],
        metavar="P",
        help="with --loader: recipes whose batches are loaded (default: %(default)s)",
    )
    parser.add_argument(
        "--batches", type=int, default=4, help="of each, with --loader (default: %(default)s)"
    )
    parser.add_argument(
        "--serve",
        nargs="?",
        const=SMALL,
        metavar="POLICY",
        help="instead: a policy behind a socket against copies of it (a small transformer if none is named)",
    )
    parser.add_argument("--compile", action="store_true", help="with --serve: also with a compiled network")
    parser.add_argument("--sessions", **NUMBERS, default=[1, 4, 8, 16], metavar="N", help="with --serve")
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="of each rate, with --serve (default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Measure and print the table."""
    bounds = {
        "n_action_steps": (1, MAX_STEPS),
        "repeats": (1, MAX_REPEATS),
        "batches": (1, MAX_BATCHES),
        "sessions": (1, MAX_SESSIONS),
        "seconds": (0.1, MAX_SECONDS),
        "workers": (1, MAX_WORKERS),
        "episodes": (1, MAX_MEASURED_EPISODES),
        "baseline_episodes": (2, MAX_MEASURED_EPISODES),
    }
    check_bounds(args, bounds, prefix="bench: ")
    _look_for(args)
    if args.serve is not None:
        return _serving(args)
    if args.against_official is not None:
        return _official(args)
    return _loader(args) if args.loader else _rendering(args)


def _look_for(args: argparse.Namespace) -> None:
    """Look for what is named, before torch or a simulator is loaded."""
    from vla_eval.config.policy import load_policy
    from vla_eval.data.info_file import require_folder
    from vla_eval.policies.recipe import load_policy_recipe
    from vla_eval.tasks.catalog import task_spec

    task_spec(args.task)
    if args.serve:
        load_policy_recipe(args.serve)
    if args.loader:
        for name in args.policy:
            load_policy(name)
    if args.against_official and shutil.which(args.against_official) is None:
        raise MissingDependencyError(
            f"bench: expected a Python interpreter that has mikasa-robo-suite at {args.against_official}, "
            "found none. docs/speed.md says how to install it."
        )
    if args.loader not in (None, SYNTHETIC):
        require_folder(Path(args.loader))


def _loader(args: argparse.Namespace) -> int:
    from vla_eval.bench.loader import run_loader_bench

    root = None if args.loader == SYNTHETIC else Path(args.loader)
    report = run_loader_bench(root, args.policy, n_batches=args.batches, repeats=args.repeats)
    print(
        f"{report.dataset}: {report.n_frames} frames, decoder {report.decoder}; when it began, "
        f"{report.load:.1f} other processes wanted a core. Samples per second:"
    )
    print("| policy | batch | frames of a sample | loader processes | lerobot | ours | ratio | opened in s |")
    print("|:--|--:|--:|--:|--:|--:|--:|--:|")
    for row in report.rows:
        print(
            f"| {row.policy} | {row.batch_size} | {row.n_frames} | {row.n_processes} "
            f"| {row.lerobot_per_second:.1f} | {row.ours_per_second:.1f} | {row.ratio:.1f} "
            f"| {row.first_seconds:.2f}, {row.again_seconds:.2f} again |"
        )
    print("Samples of both loaders were bit-equal.")
    return 0


def _rendering(args: argparse.Namespace) -> int:
    from vla_eval.bench.parts import measure_parts
    from vla_eval.bench.rendering import run_bench
    from vla_eval.config.environment import RenderSettings

    report = run_bench(
        args.task,
        chunk_lengths=args.n_action_steps,
        repeats=args.repeats,
        wrist_mesh=RenderSettings(wrist_mesh=args.wrist_mesh),
    )
    print(f"{report.task}, two cameras of 128 x 128, {report.device}, wrist mesh: {report.wrist_mesh}")
    print(f"a step without rendering: {report.physics_ms:.1f} ms")
    print("| K | eager ms/step | lazy ms/step | ratio | eager CPU ms/step | lazy CPU ms/step | CPU ratio |")
    print("|--:|--:|--:|--:|--:|--:|--:|")
    for row in report.rows:
        print(
            f"| {row.n_action_steps} | {row.eager_ms:.1f} | {row.lazy_ms:.1f} | {row.speed_up:.1f} "
            f"| {row.eager_cpu_ms:.1f} | {row.lazy_cpu_ms:.1f} | {row.cpu_speed_up:.1f} |"
        )
    print("States and actions of lazy and eager episodes were bit-equal.")
    print("| part | CPU ms | per second and core |")
    print("|:--|--:|--:|")
    for part in measure_parts(args.task, repeats=args.repeats):
        print(f"| {part.name} | {part.cpu_ms:.2f} | {part.per_second:.0f} |")
    return 0


def _official(args: argparse.Namespace) -> int:
    from vla_eval.bench.official import run_official_bench

    report = run_official_bench(
        args.task,
        python=Path(args.against_official) if args.against_official else None,
        chunk_lengths=args.n_action_steps,
        n_workers=args.workers,
        n_episodes=args.episodes,
        n_baseline_episodes=args.baseline_episodes,
    )
    costs, baseline = report.costs, report.baseline
    print(
        f"{report.task}, two cameras of 128 x 128; when it began, {report.load:.1f} other processes wanted a "
        "core"
    )
    print(
        f"CPU milliseconds: a step {costs.step_ms:.1f}, a frame of both cameras {costs.frame_ms:.1f}, "
        f"a reset without its frame {costs.reset_ms:.1f}"
    )
    cpu = (
        "" if baseline.cpu_seconds is None else f", {baseline.cpu_seconds / baseline.n_steps:.3f} CPU s each"
    )
    print(
        f"{baseline.name}, one process, every step rendered: {baseline.per_second:.1f} steps/s{cpu}; "
        f"start-up {baseline.start_seconds:.1f} s"
    )
    print(f"ours, {report.n_workers} workers, {report.n_episodes} episodes, start-up included:")
    print("| K | steps/s | ratio | ratio, both starts | CPU s/frame | first record s | wall s | wall/floor |")
    print("|--:|--:|--:|--:|--:|--:|--:|--:|")
    for row in report.rows:
        print(
            f"| {row.n_action_steps} | {row.n_steps / row.seconds:.1f} | {report.ratio(row):.1f} "
            f"| {report.ratio_with_both_starts(row):.1f} | {row.cpu_seconds / row.n_frames:.3f} "
            f"| {row.first_seconds:.1f} | {row.seconds:.1f} | {row.seconds / row.floor_seconds:.2f} |"
        )
    print("ratio: the start-up is counted for ours and not for the other one.")
    return 0


def _serving(args: argparse.Namespace) -> int:
    from vla_eval.bench.serving import run_serving_bench

    report = run_serving_bench(
        args.serve or None, sessions=args.sessions, seconds=args.seconds, compiles=args.compile
    )
    n_parameters = report.n_parameters
    size = "" if n_parameters is None else f", {n_parameters / 1e6:.1f} M parameters"
    print(
        f"{report.policy}{size}; {report.device or 'no GPU'}; {report.n_cores} cores, which "
        f"{report.load:.1f} other processes wanted when it began"
    )
    print(
        f"A policy that computes nothing, two images of 128 x 128, {report.n_latencies} inferences in turn: "
        f"{report.direct.p50:.2f} ms in the process, {report.served.p50:.2f} ms behind the loopback address "
        f"(p99 {report.direct.p99:.2f} and {report.served.p99:.2f}): {report.added.p50:.2f} ms added "
        f"(p99 {report.added.p99:.2f})."
    )
    more = " compiled/s | MiB | GPU MiB |" if args.compile else ""
    print(f"| sessions | served/s | MiB | GPU MiB |{more} copies | copies/s | MiB | GPU MiB |")
    print(f"|--:|--:|--:|--:|{'--:|' * more.count('|')}--:|--:|--:|--:|")
    for row in report.rows:
        served, compiled, copies = map(_load, (row.served, row.compiled, row.copies))
        print(f"| {row.n_sessions} {served} {compiled}| {row.n_copies} {copies} |")
    if report.compilation:
        print(report.compilation)
    print("Copies are processes with one thread each, no more than there are cores.")
    for one in report.rounding:
        print(
            f"{one.precision}: actions of a pass with {one.n_rows} rows and of one with a single row differ "
            f"by at most {one.largest:.2g}; the largest action is {one.scale:.2g}."
        )
    return 0


def _load(load: "Load | None") -> str:
    if load is None:
        return ""
    return f"| {load.per_second:.1f} | {load.resident_bytes / MIB:.0f} | {_mib(load.device_bytes)}"


def _mib(n_bytes: int | None) -> str:
    return "—" if n_bytes is None else f"{n_bytes / MIB:.0f}"
