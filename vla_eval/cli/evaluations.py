"""Run several evaluations one after another, each in a folder of its own: audits, probes and tables."""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from vla_eval.cli import progress
from vla_eval.cli.arguments import typed_command
from vla_eval.config.evaluation import EvalConfig
from vla_eval.workers.backend import Backend


class Evaluations(NamedTuple):
    """The result of several evaluations.

    Attributes:
        n_errors: episodes that ended in an error.
        stopped: the exit code if a signal has stopped them; None: all are there.
    """

    n_errors: int
    stopped: int | None


def evaluate_each(
    runs: Iterable[tuple[Path, EvalConfig]], args: argparse.Namespace, *, backend: Backend
) -> Evaluations:
    """Run or resume each evaluation; a signal stops the one that runs, and those after it.

    Args:
        runs: run folder and configuration of each.
        args: of the command line: `--shard`, `--allow-environment-change` and `--json-progress`.
        backend: where the workers run.

    Raises:
        VlaEvalError: see `evaluate`.
    """
    command, n_errors = typed_command(), 0
    with progress.stop_on_signals() as stop:
        for out, config in runs:
            summary = progress.evaluate_with_progress(
                config,
                out=out,
                command=command,
                stop=stop,
                allow_environment_change=args.allow_environment_change,
                shard=args.shard,
                backend=backend,
                json_progress=args.json_progress,
            )
            n_errors += summary.n_errors
            if summary.was_stopped:
                print(f"Stopped. To resume: {command}", file=sys.stderr)
                return Evaluations(n_errors, stop.exit_code)
    return Evaluations(n_errors, None)
