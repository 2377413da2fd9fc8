"""Run the evaluations of a probe one after another, each in a folder of its own."""

import sys
from collections.abc import Sequence
from pathlib import Path

from vla_eval.cli.arguments import typed_command
from vla_eval.config.evaluation import EvalConfig


def run_all(configs: Sequence[EvalConfig], out: Path) -> int | None:
    """Run or resume each evaluation in `out/NAME`.

    Returns:
        None once all are there; the exit code if a signal has stopped them.

    Raises:
        VlaEvalError: as for `evaluate`.
    """
    from vla_eval.cli.progress import evaluate_with_progress, stop_on_signals

    command = typed_command()
    with stop_on_signals() as stop:
        for config in configs:
            summary = evaluate_with_progress(config, out=out / config.name, command=command, stop=stop)
            if summary.was_stopped:
                print(f"Stopped. To resume: {command}", file=sys.stderr)
                return stop.exit_code
    return None
