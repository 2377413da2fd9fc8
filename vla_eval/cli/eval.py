"""`mikasa-vla eval`: run or resume an evaluation, and print its table."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_eval.cli.shared.arguments import (
    EXIT_EPISODE_ERRORS,
    FLAGS,
    add_flags,
    add_old_flag,
    env_paths,
    positive_argument,
    read_config,
    set_flags,
    suite_tasks,
    typed_command,
)
from vla_eval.cli.shared.cluster import backend_of
from vla_eval.cli.shared.output import add_table_arguments
from vla_eval.config.agents import is_agent_table
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.config.protocol import fill_from_protocol
from vla_eval.errors import RecipeError, unknown_name
from vla_eval.storage.shard import shard_folder
from vla_eval.strict.decoding import set_field
from vla_eval.workers.needed_files import Needed, shared_folder

if TYPE_CHECKING:
    from vla_eval.evaluation.resolve import ResolvedEvaluation

DESCRIPTION = """Run the episodes of a configuration that have no result yet, and print the table.

CONFIG is a file, or the name of one in configs/ (`mikasa-vla list configs`). Without it, name at least
one --task (or a --protocol) and one --policy. Flags go on top of the file, --set on top of flags. The same
command again resumes where it stopped, and retries episodes that ended in an error."""
EPILOG = """exit codes: 0 every episode has a result; 1 a mistake (see the message); 3 some episodes ended in
an error (the same command retries them); 130, 143 stopped by Ctrl-C, SIGTERM."""
CAPTURES = {
    "video": "an mp4",
    "rrd": "a file for the rerun viewer",
    "strip": "a drawing of commands, the arm's way and borders of chunks",
}
"""What may be kept of an episode, by its field of `capture`."""
RECIPE_FLAGS = (
    *("tasks", "policies", "protocol", "n_action_steps", "episodes", "seed_start", "runs", "workers"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description, parser.epilog = DESCRIPTION, EPILOG
    parser.add_argument("config", nargs="?", metavar="CONFIG", help="file, or name in configs/")
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="a published protocol (`mikasa-vla list protocols`): its tasks, seeds and runs, unless the file "
        "or a flag sets others, and its summary figure below the table",
    )
    _add_run_arguments(parser)
    parser.add_argument(
        "--delay-trace",
        metavar="RUN",
        help="replay the inference delays of another run (chunking.delay.trace)",
    )
    parser.add_argument("--suite", metavar="NAME", help="all tasks of a suite: `mikasa_base` …")
    for kind, what in CAPTURES.items():
        parser.add_argument(
            f"--capture-{kind}",
            metavar="WHICH",
            help=f"{what} of all|failures|successes episodes, or of the first N of each row (none)",
        )
    for kind in ("video", "rrd"):
        add_old_flag(parser, f"--record-{kind}", f"--capture-{kind}")
    add_table_arguments(parser)
    parser.add_argument(
        "--tiny",
        action="store_true",
        help="of a table of learned policies: do all of it with tiny random models, without a simulator",
    )
    parser.add_argument(
        "--html", type=Path, metavar="DIR", help="also write a page: DIR/index.html; its path comes last"
    )


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    add_flags(
        parser,
        task="task ids (`mikasa-vla list tasks`)",
        policy="names in policies/, files, folders or hub:OWNER/NAME@REVISION of checkpoints, or "
        "ws://HOST:PORT of a policy server; NAME=DIR,DIR,DIR: one row whose runs are these checkpoints; "
        "NAME:TASK=DIR, several: one per task",
        n_action_steps="actions executed per inference; several: one after another",
        episodes="episodes per task, policy and run (100)",
    )
    parser.add_argument("--runs", type=int, metavar="R", help="independent runs over the same seeds (1)")
    parser.add_argument(
        "--serve",
        action="store_true",
        help="load each model once, in a server that all workers share (inference: shared)",
    )
    add_flags(
        parser,
        *("--seed-start", "--workers", "--cluster", "--shard", "--json-progress", "--dry-run"),
        out="run folder (runs/NAME-FINGERPRINT)",
        set="change any field of the configuration",
        allow_environment_change=f"{FLAGS['--allow-environment-change']['help']}; the table will say so",
    )
    _add_dry_run_arguments(parser)


def _add_dry_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--steps-per-second",
        type=positive_argument,
        metavar="N",
        help="with --dry-run: control steps of a worker without images to assume (500)",
    )
    parser.add_argument(
        "--frames-per-second",
        type=positive_argument,
        metavar="N",
        help="with --dry-run: images of a worker to assume (50)",
    )
    parser.add_argument(
        "--inference-seconds",
        type=positive_argument,
        metavar="S",
        help="with --dry-run: an inference of a learned policy to assume (0.2)",
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, then print the table to standard output; everything else goes to standard error."""
    from vla_eval.cli.shared.evaluations import evaluate_one
    from vla_eval.cli.shared.output import (
        check_baseline,
        check_table_arguments,
        hint_merge,
        print_table,
        write_html,
    )
    from vla_eval.cli.terminal.progress import stop_on_signals
    from vla_eval.evaluation.needed_files import needed_files
    from vla_eval.evaluation.resolve import ResolvedEvaluation
    from vla_eval.policies.entries import load_policy_entries, refuse_unfetched
    from vla_eval.storage.run_folder import read_run
    from vla_eval.storage.starting import RUNS_FOLDER

    if args.config is not None:
        from vla_eval.evaluation.model_table import is_model_table

        if is_model_table(args.config):
            from vla_eval.cli.shared.model_table import evaluate_table

            return evaluate_table(args)
        if is_agent_table(args.config):
            raise RecipeError(
                f"{args.config:.200}: is of trainings. Run `mikasa-vla train-agent {args.config:.200}`; its "
                "last line is the command that evaluates them."
            )
    if args.tiny:
        raise RecipeError("--tiny is for a table of learned policies, such as configs/paper_vla_table.yaml.")
    config = _config(args)
    check_table_arguments(args)
    if args.dry_run:
        refuse_unfetched(config.policies)
    policies = load_policy_entries(config.policies)
    check_baseline(args.baseline, [policy.name for policy in policies])

    def needs() -> tuple[Needed, ...]:
        captured = (shared_folder(args.out or RUNS_FOLDER),) if config.capture.writes_files else ()
        return (*needed_files(policies), *captured)

    with backend_of(args, needs=needs) as backend:
        out = shard_folder(args.out, args.shard) if args.out else None
        resolved = ResolvedEvaluation.of(config, policies, backend=backend, out=out, shard=args.shard)
        if args.dry_run:
            return _dry_run(resolved, args)
        with stop_on_signals() as stop:
            summary = evaluate_one(resolved, args, stop=stop)
    out = resolved.out
    if summary.was_stopped:
        n_done = summary.n_episodes - summary.n_open
        print(
            f"Stopped with {n_done}/{summary.n_episodes} episodes in {out}. To resume: {typed_command()}",
            file=sys.stderr,
        )
        return stop.exit_code
    found = read_run(out)
    print_table([found], args)
    if summary.n_errors:
        print(
            f"{summary.n_errors} episodes ended in an error and are not in the rates; the same command "
            f"retries them. Causes: {out}/episodes.jsonl, {out}/logs/.",
            file=sys.stderr,
        )
    if args.html is not None:
        write_html([found], args)
    if args.shard is not None:
        hint_merge(args.out or resolved.default_folder, args.shard)
    return EXIT_EPISODE_ERRORS if summary.n_errors else 0


def _dry_run(resolved: "ResolvedEvaluation", args: argparse.Namespace) -> int:
    from vla_eval.evaluation.dry_run import AssumedRates, describe_evaluation

    names = ("steps_per_second", "frames_per_second", "inference_seconds")
    named = {name: getattr(args, name) for name in names}
    rates = AssumedRates(**{name: value for name, value in named.items() if value is not None})
    allowed = args.allow_environment_change
    print("\n".join(describe_evaluation(resolved, rates=rates, allow_environment_change=allowed)))
    return 0


def _which(text: str, *, flag: str) -> str | int:
    """Read which episodes to capture."""
    if text.isascii() and text.isdigit():
        return int(text)
    known = ("none", "all", "failures", "successes")
    if text not in known:
        raise unknown_name("choice of episodes", text, (*known, "N (a number)"), where=flag)
    return text


def _tasks_of(args: argparse.Namespace) -> list[str]:
    """Return all tasks of the suite that is named in place of tasks."""
    if args.tasks is not None:
        raise RecipeError("--task and --suite: name tasks or a suite, not both.")
    return list(suite_tasks(args.suite))


def _config(args: argparse.Namespace) -> EvalConfig:
    def edit(data: dict[str, Any]) -> None:  # Any: plain data of YAML
        set_flags(data, args, RECIPE_FLAGS)
        if args.suite is not None:
            data["tasks"] = _tasks_of(args)
        if args.serve:
            data["inference"] = "shared"
        if args.delay_trace is not None:
            set_field(EvalConfig, data, "chunking.delay", {"trace": args.delay_trace}, where="--delay-trace")
        for kind in CAPTURES:
            which = getattr(args, f"capture_{kind}")
            if which is not None:
                flag = f"--capture-{kind}"
                set_field(EvalConfig, data, f"capture.{kind}", _which(which, flag=flag), where=flag)
        apply_overrides(data, args.overrides, cls=EvalConfig, free=env_paths(args.overrides))
        fill_from_protocol(data)

    return read_config(
        EvalConfig,
        edit,
        folder="configs",
        name=args.config,
        start={"name": args.protocol or "eval"},
        asks="a configuration (`mikasa-vla list configs`), or at least one --task (or a --protocol) and one "
        "--policy",
        needed={"tasks": "--task", "policies": "--policy"},
        example="eval --task RememberColor3-v0 --policy oracle",
    )
