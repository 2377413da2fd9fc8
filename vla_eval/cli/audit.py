"""`mikasa-vla audit`: which tasks can be won without remembering?"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_eval.cli.shared.arguments import EXIT_EPISODE_ERRORS, FLAGS, MANY, add_flags, env_paths, suite_tasks
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.errors import RecipeError
from vla_eval.storage.shard import shard_folder
from vla_eval.strict.decoding import decode

DESCRIPTION = """Run the oracle and the controls that need no memory on every task, and name the shortcuts by
which a task can be won: without acting, by touching one candidate after another, by staying at the cue,
by storing the cue in the gripper. Nothing is rendered.

Protocols: 'paper' is the task as it is; under 'strict' arm and gripper are held until the choice and the
first choice is final. The official package's tasks (--suite mikasa_vla_90) have one, 'official'; MIKASA-Base
(--suite mikasa_base) has no arm to hold, and controls of its own: 'random', 'memoryless', 'oracle'. The same
command resumes a stopped audit."""

EPISODES, STORED_FRAMES_EPISODES = 30, 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, "docs/audit.md explains controls, tests and verdicts."
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--task", **{**FLAGS["--task"], "help": "task ids (all of the suite)"})
    which.add_argument(
        "--suite",
        choices=("paper", "objects", "mikasa_vla_90", "mikasa_base"),
        default="paper",
        help="the paper's 32 tasks (paper), those with everyday things, the official package's 90, or "
        "MIKASA-Base",
    )
    parser.add_argument("--control", **MANY, dest="controls", metavar="C", help="only these controls")
    parser.add_argument(
        "--protocol",
        choices=("paper", "strict", "both"),
        default="both",
        help="(both); official tasks and MIKASA-Base have their own",
    )
    parser.add_argument(
        "--stored-frames",
        action="store_true",
        help="ask how many frames have to be stored, by linear probes on the oracle's episodes (100)",
    )
    add_flags(
        parser,
        *("--workers", "--cluster", "--shard", "--json-progress", "--allow-environment-change"),
        episodes="per task and control (30)",
        out="(runs/audit)",
        set="change another field of the evaluations, for example simulator=fake",
    )
    parser.set_defaults(episodes=None, workers="auto", out=Path("runs/audit"))
    parser.add_argument("--format", choices=("markdown", "json"), default="markdown", help="(markdown)")


def run(args: argparse.Namespace) -> int:
    """Run the controls, then print the audit to standard output; everything else goes to standard error."""
    from vla_eval.audit.audit_text import render_audit
    from vla_eval.audit.base_audit import base_audit_config, read_base_audit, render_base_audit
    from vla_eval.audit.evaluations import read_audit
    from vla_eval.tasks.catalog import task_spec

    tasks, settings = _tasks_and_settings(args)
    if args.stored_frames:
        return _run_stored_frames(args, tasks, settings)
    args.episodes = EPISODES if args.episodes is None else args.episodes
    if all(task_spec(task).is_base for task in tasks):  # its controls and its verdict are others
        if args.protocol == "strict":
            raise RecipeError(
                "--protocol strict: MIKASA-Base has no arm to hold until the choice. Leave --protocol out."
            )
        config = base_audit_config(
            tasks,
            episodes=args.episodes,
            workers=args.workers,
            controls=args.controls,
            settings=settings,
        )
        return _evaluate(
            args, (config,), lambda: render_base_audit(read_base_audit(config, args.out), args.format)
        )
    configs = _configs(args, tasks, settings)
    return _evaluate(args, configs, lambda: render_audit(read_audit(configs, args.out), args.format))


def _run_stored_frames(args: argparse.Namespace, tasks: tuple[str, ...], settings: dict[str, Any]) -> int:
    from vla_eval.audit.stored_frames import read_stored_frames, render_stored_frames, stored_frames_config

    if args.controls is not None or args.protocol != "both":
        raise RecipeError(
            "--stored-frames has one control and one protocol. Leave --control and --protocol out."
        )
    config = stored_frames_config(
        tasks,
        episodes=STORED_FRAMES_EPISODES if args.episodes is None else args.episodes,
        workers=args.workers,
        settings=settings,
    )
    return _evaluate(
        args, (config,), lambda: render_stored_frames(read_stored_frames(config, args.out), args.format)
    )


def _evaluate(args: argparse.Namespace, configs: tuple[EvalConfig, ...], render: Callable[[], str]) -> int:
    """Run the evaluations, print what is rendered of them, and return the exit code."""
    from vla_eval.cli.shared.evaluations import evaluate_each
    from vla_eval.cli.shared.output import print_in, print_shard

    out = shard_folder(args.out, args.shard)
    with backend_of(args) as backend:
        done = evaluate_each(((out / config.name, config) for config in configs), args, backend=backend)
    if done.stopped is not None:
        return done.stopped
    if args.shard is not None:
        print_shard(out, args.out, args.shard)
    else:
        print_in(args.format, render())
    return EXIT_EPISODE_ERRORS if done.n_errors else 0


def _tasks_and_settings(args: argparse.Namespace) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the tasks, and the fields that are set, with their types."""
    settings: dict[str, Any] = {}  # Any: plain data, checked by `decode` below
    apply_overrides(settings, args.overrides, cls=EvalConfig, free=env_paths(args.overrides))
    # Read strictly, with names of nothing: for the types of what was set.
    checked = decode(EvalConfig, {"name": "x", "tasks": ["x"], "policies": ["x"], **settings}, where="--set")
    return args.tasks or suite_tasks(args.suite), {name: getattr(checked, name) for name in settings}


def _configs(
    args: argparse.Namespace, tasks: tuple[str, ...], settings: dict[str, Any]
) -> tuple[EvalConfig, ...]:
    from vla_eval.audit.evaluations import audit_configs, protocols_of
    from vla_eval.results.shipped_audit import AuditProtocol

    wanted: tuple[AuditProtocol, ...] = ("paper", "strict") if args.protocol == "both" else (args.protocol,)
    return audit_configs(
        tasks,
        protocols_of(tasks, wanted),
        episodes=args.episodes,
        workers=args.workers,
        controls=args.controls,
        settings=settings,
    )
