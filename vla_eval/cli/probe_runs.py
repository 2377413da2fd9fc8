"""Run the evaluations of a probe one after another, each in a folder of its own."""

import argparse
import sys
from collections.abc import Sequence

from vla_eval.cli.arguments import EXIT_EPISODE_ERRORS, typed_command
from vla_eval.cli.cluster import backend_of
from vla_eval.config.evaluation import EvalConfig
from vla_eval.storage.shard import shard_folder
from vla_eval.workers.needed import Needed


def run_all(configs: Sequence[EvalConfig], args: argparse.Namespace) -> int | None:
    """Run or resume each evaluation in `OUT/NAME`, or one shard of each, on `--cluster`.

    Returns:
        None once all are there; the exit code after a shard, or if a signal has stopped them.

    Raises:
        VlaEvalError: as for `evaluate`.
    """
    from vla_eval.cli.output import print_shard
    from vla_eval.cli.progress import evaluate_with_progress, stop_on_signals

    out, command, n_errors = shard_folder(args.out, args.shard), typed_command(), 0
    with backend_of(args, needs=lambda: _needed(configs)) as backend, stop_on_signals() as stop:
        for config in configs:
            summary = evaluate_with_progress(
                config,
                out=out / config.name,
                command=command,
                stop=stop,
                allow_environment_change=args.allow_environment_change,
                shard=args.shard,
                backend=backend,
                json_progress=args.json_progress,
            )
            if summary.was_stopped:
                print(f"Stopped. To resume: {command}", file=sys.stderr)
                return stop.exit_code
            n_errors += summary.n_errors
    if args.shard is None:
        return None
    print_shard(out, args.out, args.shard)
    return EXIT_EPISODE_ERRORS if n_errors else 0


def _needed(configs: Sequence[EvalConfig]) -> tuple[Needed, ...]:
    from vla_eval.evaluation.needed import needed_files

    return tuple(dict.fromkeys(need for config in configs for need in needed_files(config)))
