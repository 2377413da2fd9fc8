"""Run evaluations as the command line asks: one, or several one after another, each in its own folder."""

import argparse
import itertools
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from vla_eval.cli.shared.arguments import typed_command
from vla_eval.cli.terminal import progress
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import FolderInUseError
from vla_eval.evaluation.evaluate import EvaluationSummary
from vla_eval.evaluation.resolve import ResolvedEvaluation, resolve
from vla_eval.workers.backend import Backend


class Evaluations(NamedTuple):
    """The result of several evaluations."""

    n_errors: int  # episodes that ended in an error
    stopped: int | None  # the exit code if a signal has stopped them; None: all are there


def evaluate_one(
    resolved: ResolvedEvaluation, args: argparse.Namespace, *, stop: progress.StopRequest
) -> EvaluationSummary:
    """Run or resume an evaluation as the command line asks, with progress; `args` as for `evaluate_each`."""
    return progress.evaluate_with_progress(
        resolved,
        command=typed_command(),
        stop=stop,
        allow_environment_change=args.allow_environment_change,
        json_progress=args.json_progress,
    )


def evaluate_each(
    runs: Iterable[tuple[Path, EvalConfig]], args: argparse.Namespace, *, backend: Backend
) -> Evaluations:
    """Run or resume each evaluation, (run folder, configuration), until a signal stops it."""
    n_errors = 0
    with progress.stop_on_signals() as stop:

        def run(out: Path, config: EvalConfig) -> bool:
            nonlocal n_errors
            resolved = resolve(config, backend=backend, out=out, shard=args.shard)
            summary = evaluate_one(resolved, args, stop=stop)
            n_errors += summary.n_errors
            return summary.was_stopped

        was_stopped = in_turn(runs, run)
    if was_stopped:
        print(f"Stopped. To resume: {typed_command()}", file=sys.stderr)
    return Evaluations(n_errors, stop.exit_code if was_stopped else None)


def in_turn(
    runs: Iterable[tuple[Path, EvalConfig]], run: Callable[[Path, EvalConfig], bool | None]
) -> bool | None:
    """Run each until one is stopped; one that another process is writing comes last."""
    put_off: list[tuple[Path, EvalConfig]] = []
    for out, config in itertools.chain(runs, put_off):  # which grows meanwhile
        try:
            if run(out, config):
                return True
        except FolderInUseError:
            if (out, config) in put_off:
                raise
            print(f"{out}: another process is writing into it; it comes last.", file=sys.stderr)
            put_off.append((out, config))
    return False
