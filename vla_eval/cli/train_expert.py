"""`mikasa-vla train-expert`: learn an expert by PPO on the true state, on a processor."""

import argparse
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.bounds import MAX_PROCESSES, MAX_SLOTS, MAX_TRAINING_STEPS, check_bounds, check_seeds

if TYPE_CHECKING:
    from vla_eval.training.ppo_expert import PpoProgress

N_RECENT = 10  # iterations over which success is averaged: one has only 16 episodes


def add_parser(subparsers: "argparse._SubParsersAction[Any]") -> None:
    """Declare the arguments."""
    parser = subparsers.add_parser(
        "train-expert", help="learn an expert by PPO on the true state", allow_abbrev=False
    )
    parser.add_argument("--task", required=True, metavar="T", help="task id")
    parser.add_argument("--steps", required=True, type=int, metavar="N", help="control steps altogether")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder; goes on if it exists")
    parser.add_argument("--seed", type=int, default=0, help="of everything (default: %(default)s)")
    parser.add_argument("--envs", type=int, default=16, help="episodes per iteration (default: %(default)s)")
    parser.add_argument(
        "--dims",
        nargs="+",
        default=["dx", "dy", "dz"],
        metavar="DIM",
        help="dimensions of the action to learn; the others are held (default: dx dy dz)",
    )
    parser.add_argument(
        "--gripper", type=float, default=1.0, help="its command while it is held (default: 1, open)"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes; moves no result (default: 1)")
    parser.add_argument(
        "--simulator", choices=("maniskill", "fake"), default="maniskill", help="fake: for dry runs"
    )


def run(args: argparse.Namespace) -> int:
    """Learn, and say how it goes."""
    from vla_eval.cli.progress import stop_on_signals
    from vla_eval.errors import RecipeError
    from vla_eval.tasks.catalog import task_spec

    bounds = {"steps": (1, MAX_TRAINING_STEPS), "envs": (1, MAX_SLOTS), "workers": (1, MAX_PROCESSES)}
    check_bounds(args, bounds, prefix="--")
    check_seeds(args.seed, name="--seed")
    if not math.isfinite(args.gripper):
        raise RecipeError(f"--gripper is {args.gripper}, expected a finite number.")
    task = task_spec(args.task).id
    from vla_eval.training.ppo_expert import POLICY_FILE, train_expert
    from vla_eval.training.ppo_settings import PpoSettings

    settings = PpoSettings(
        task=task,
        seed=args.seed,
        n_envs=args.envs,
        simulator=args.simulator,
        learned_dims=tuple(args.dims),
        held_gripper=args.gripper,
    )
    recent: list[float] = []
    begun = time.monotonic()
    with stop_on_signals() as stop:

        def on_progress(progress: "PpoProgress") -> bool:
            recent.append(progress.success)
            del recent[:-N_RECENT]
            print(
                f"{progress.n_steps}/{args.steps} steps after {(time.monotonic() - begun) / 60:.1f} min, "
                f"{progress.steps_per_second:.0f} steps/s, success {sum(recent) / len(recent):.2f}, "
                f"reward {progress.mean_reward:.3f}, std {progress.action_std:.2f}",
                file=sys.stderr,
                flush=True,
            )
            return stop.signal_number is not None

        progress = train_expert(
            settings, n_steps=args.steps, out=args.out, n_workers=args.workers, on_progress=on_progress
        )
    print(f"{args.out}: {progress.n_steps} steps, success while exploring {progress.success:.2f}")
    print(f"evaluate it: mikasa-vla eval --task {task} --policy {args.out / POLICY_FILE}")
    return stop.exit_code if stop.signal_number is not None else 0
