"""CPU milliseconds of what an evaluation is made of: a control step, a reset, a frame.

Needs little of the package, so that the same file measures an earlier commit: see `docs/speed.md`.
"""

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vla_eval.config.environment import EnvSettings
from vla_eval.core import SimEnv
from vla_eval.envs.factory import make_env

CAMERAS = ("base_camera", "hand_camera")
N_SLOTS = 8
N_STEPS, N_RESETS, N_FRAMES = 40, 5, 12


class Part(NamedTuple):
    """What is measured, and its CPU time in one process: the lowest of several."""

    name: str
    cpu_ms: float

    @property
    def per_second(self) -> float:
        """How many of them one core does in a second."""
        return 1000 / self.cpu_ms


def measure_parts(task: str, *, repeats: int) -> tuple[Part, ...]:
    """Measure a task on the CPU simulator, with random actions."""
    blind, several, seeing = (
        make_env(EnvSettings(task=task, n_slots=n, cameras=cameras))
        for n, cameras in ((1, ()), (N_SLOTS, ()), (1, CAMERAS))
    )

    def parts() -> tuple[float, ...]:
        step = _steps_ms(blind, 1)
        drawn = _steps_ms(seeing, 1, render=True)
        return (
            step,
            _steps_ms(several, N_SLOTS),
            drawn - step,
            _cpu_ms(N_RESETS, lambda seed: blind.reset({0: seed}, render=False)),
            _cpu_ms(N_RESETS, lambda seed: seeing.reset({0: seed}, render=True)),
        )

    parts()  # starts the renderer
    rows = [parts() for _ in range(repeats)]
    for env in (blind, several, seeing):
        env.close()
    names = (
        "control step without a frame",
        f"the same per slot, {N_SLOTS} slots",
        "frame of both cameras",
        "reset without cameras",
        "reset with a frame",
    )
    return tuple(Part(name, min(times)) for name, times in zip(names, zip(*rows, strict=True), strict=True))


def _steps_ms(env: SimEnv, n_slots: int, *, render: bool = False) -> float:
    """Return the time of a control step of one slot."""
    n = N_FRAMES if render else N_STEPS
    # Small enough that the hand keeps pointing down, as policies hold it.
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (n, len(env.spec.action.dims))).astype(np.float32)
    env.reset(dict.fromkeys(range(n_slots), 1), render=False)
    drawn = frozenset(range(n_slots)) if render else frozenset[int]()
    return _cpu_ms(n, lambda i: env.step(dict.fromkeys(range(n_slots), actions[i]), render=drawn)) / n_slots


def _cpu_ms(n: int, act: Callable[[int], object]) -> float:
    began = time.process_time()
    for i in range(n):
        act(i)
    return 1000 * (time.process_time() - began) / n


if __name__ == "__main__":
    for part in measure_parts(sys.argv[1] if len(sys.argv) > 1 else "RememberColor3-v0", repeats=3):
        print(f"{part.cpu_ms:8.2f} {part.per_second:6.0f}/s  {part.name}")
