"""What a training tells on its way: a line of metrics per update, and a line for a person now and then."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any  # values of the library's logger

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from vla_eval.agents.job import AgentJob
from vla_eval.agents.vector_env import SlotsEnv
from vla_eval.errors import MissingDependencyError
from vla_eval.training.run_folder import append_metrics

SECONDS_BETWEEN_LINES = 10.0


class Progress(BaseCallback):
    """Asked at each step whether to continue; writes what the library logs."""

    def __init__(
        self, job: AgentJob, envs: SlotsEnv, say: Callable[[str], None], is_stopping: Callable[[], bool]
    ) -> None:
        super().__init__()
        self._job, self._envs, self._say, self._is_stopping = job, envs, say, is_stopping
        self._begun, self._said = time.monotonic(), 0.0
        self._first_step = job.first_step
        self.was_stopped = False

    def _on_step(self) -> bool:
        self.was_stopped = self.was_stopped or self._is_stopping()
        return not self.was_stopped

    def write(self, values: dict[str, Any], step: int) -> None:
        """Take what the library logs of an update, and add the episodes that have ended since."""
        ended, self._envs.finished = self._envs.finished, []
        line: dict[str, float | str] = {"step": step, "n_episodes": len(ended)}
        if ended:
            line["episode_return"] = float(np.mean([one.episode_return for one in ended]))
            line["success"] = float(np.mean([one.success for one in ended]))
            line["episode_steps"] = float(np.mean([one.n_steps for one in ended]))
        seconds = time.monotonic() - self._begun
        line["steps_per_s"] = (step - self._first_step) / max(seconds, 1e-9)
        for name, value in values.items():
            if name.startswith("train/") and isinstance(value, int | float | np.number):
                line[name.removeprefix("train/")] = float(value)
        append_metrics(self._job.out, line)
        self._tell(line, seconds)

    def _tell(self, line: dict[str, float | str], seconds: float) -> None:
        step, steps = int(line["step"]), self._job.recipe.steps
        if seconds - self._said < SECONDS_BETWEEN_LINES and step < steps:
            return
        self._said = seconds
        rate = float(line["steps_per_s"])
        shown = [f"step {step:,}/{steps:,}"]
        if "episode_return" in line:
            shown.append(f"return {float(line['episode_return']):.3g}, success {float(line['success']):.2f}")
        elif self._job.algorithm.imitates:
            shown.append(f"loss {float(line['loss']):.3g}")
        shown.append(f"{rate:,.0f} steps/s, {(steps - step) / max(rate, 1e-9) / 60:.0f} min left")
        self._say("  ".join(shown))


class _Writer(KVWriter):
    """Hands the library's numbers on."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        """Take the numbers of an update."""
        self._progress.write(key_values, step)

    def close(self) -> None:
        """Do nothing."""


def quiet_logger(progress: Progress, tensorboard: Path | None) -> Logger:
    """Return the library's logger, which prints nothing."""
    outputs: list[KVWriter] = [_Writer(progress)]
    if tensorboard is not None:
        try:
            outputs.append(TensorBoardOutputFormat(str(tensorboard)))
        except (ImportError, AssertionError) as exc:  # by which the library says that it is not there
            raise MissingDependencyError(
                "train_agent.tensorboard: the package 'tensorboard' is not installed. Install it with pip "
                "install 'mikasa-vla-eval[tensorboard]', or leave the field out: metrics.jsonl has it all."
            ) from exc
    return Logger(folder=None, output_formats=outputs)
