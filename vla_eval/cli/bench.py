"""`mikasa-vla bench`: lazy against eager rendering, as ratios measured in one run."""

import argparse


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the verb to the command line."""
    parser = subparsers.add_parser("bench", help="measure what lazy rendering saves, as ratios from one run")
    parser.add_argument("--task", default="RememberColor3-v0", help="task id (default: %(default)s)")
    parser.add_argument("--n-action-steps", type=int, nargs="+", default=[1, 4, 8], metavar="K")
    parser.add_argument("--repeats", type=int, default=2, help="the lowest of so many times counts")
    parser.add_argument("--wrist-mesh", choices=("shipped", "simplified"), default="shipped")


def run(args: argparse.Namespace) -> int:
    """Measure and print the table."""
    from vla_eval.bench import run_bench
    from vla_eval.envs.settings import RenderSettings

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
    return 0
