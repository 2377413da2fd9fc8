"""Metrics to services beside the file: trackio, and figures of evaluations to wandb.

Lines of metrics and checkpoints go to wandb from the training loop, by lerobot's logger.
"""

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any  # wandb and trackio are optional: not looked at by mypy

from vla_eval.errors import MissingDependencyError
from vla_eval.lock.switch import let_connect

Log = Callable[[Mapping[str, float | str]], None]
"""Takes one line of metrics, with its `step`."""


@contextlib.contextmanager
def trackio_run(project: str | None, *, name: str, settings: Mapping[str, Any]) -> Iterator[Log]:
    """Log to a trackio project while the context is open; without a project, log nowhere.

    A training that is resumed after a kill continues the run of its name. Steps between the last
    checkpoint and the kill are then there twice; `metrics.jsonl` has each once.

    Args:
        project: of trackio.
        name: of the run.
        settings: shown with the run.

    Raises:
        MissingDependencyError: trackio is not installed.
    """
    if project is None:
        yield lambda _line: None
        return
    try:
        let_connect("finetune.trackio_project", "git")
        trackio: Any = importlib.import_module("trackio")
    except ModuleNotFoundError as exc:
        raise MissingDependencyError(
            f"finetune.trackio_project: the package '{exc.name}' is not installed. Install it "
            "with pip install 'mikasa-vla-eval[trackio]', or leave the field out: metrics.jsonl has it all."
        ) from exc
    with contextlib.redirect_stdout(sys.stderr):  # standard output is for the checkpoint's folder
        # No figures of the machine: they would start threads that measure beside the training.
        quiet = {"embed": False, "auto_log_gpu": False, "auto_log_cpu": False}
        trackio.init(project=project, name=name, resume="allow", config=dict(settings), **quiet)
    try:
        yield lambda line: trackio.log(_numbers(line), step=int(line["step"]))
    finally:
        with contextlib.redirect_stdout(sys.stderr):
            trackio.finish()


def log_to_wandb(line: Mapping[str, float | str]) -> None:
    """Log figures of an evaluation to the wandb run that lerobot has begun, if there is one."""
    run = getattr(sys.modules.get("wandb"), "run", None)
    if run is not None:
        values = {f"held_out/{name}": value for name, value in _numbers(line).items()}
        run.log(values, step=int(line["step"]))


def _numbers(line: Mapping[str, float | str]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name != "step" and not isinstance(value, str)}
