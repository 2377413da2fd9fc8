"""Environments of one task in worker processes, stepped together. Knows nothing of learning.

What comes back depends on seeds and actions alone, not on the number of processes.
"""

import contextlib
import dataclasses
import multiprocessing
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import FloatArray, SimEnv, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.envs.settings import EnvSettings
from vla_eval.errors import SimulationError, SpecMismatchError
from vla_eval.task_state import PrivilegedState


class LockstepResult(NamedTuple):
    """One entry per environment.

    `states_ND`: true states. `rewards_N`: of the step. `success_N`: whether the success rule holds.
    `to_go_N`: metres from where things are to where the task wants them, see `distance_to_go_m`.
    """

    states_ND: FloatArray  # shape suffix
    rewards_N: FloatArray
    success_N: NDArray[np.bool_]
    to_go_N: FloatArray


class LockstepEnvs:
    """`n_envs` environments in `n_workers` processes; a context manager.

    Args:
        settings: of each environment; must be privileged.
        n_envs: how many.
        n_workers: how many processes.
    """

    def __init__(self, settings: EnvSettings, *, n_envs: int, n_workers: int) -> None:
        # Spawned: a forked child would share the parent's threads and simulator state.
        context = multiprocessing.get_context("spawn")
        self._shares = [len(share) for share in np.array_split(np.arange(n_envs), min(n_workers, n_envs))]
        self._pipes: list[Connection] = []
        self._processes = []
        for n_slots in self._shares:
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, settings, n_slots), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def __enter__(self) -> Self:
        """Wait until all environments are made."""
        try:
            self._receive()
        except Exception:
            self._close()
            raise
        return self

    def reset(self, seeds: Sequence[int]) -> LockstepResult:
        """Begin an episode in each environment."""
        return self._ask("reset", self._split(np.asarray(seeds, dtype=np.int64)))

    def step(self, actions_NA: FloatArray) -> LockstepResult:
        """Execute one control step in each environment."""
        return self._ask("step", self._split(actions_NA))

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        for pipe in self._pipes:
            pipe.close()  # a worker ends when nobody speaks to it any more
        for process in self._processes:
            process.join(timeout=10)
            if process.is_alive():
                process.kill()

    def _split(self, values: NDArray[np.generic]) -> list[NDArray[np.generic]]:
        return np.split(values, np.cumsum(self._shares)[:-1])

    def _ask(self, command: str, parts: Sequence[NDArray[np.generic]]) -> LockstepResult:
        with contextlib.suppress(OSError):  # a process that has died is told of by `_receive`
            for pipe, part in zip(self._pipes, parts, strict=True):
                pipe.send((command, part))
        return LockstepResult(*(np.concatenate(column) for column in zip(*self._receive(), strict=True)))

    def _receive(self) -> list[Any]:
        """Return an answer of each process; an exception in one of them is raised here."""
        try:
            answers = [pipe.recv() for pipe in self._pipes]
        except (EOFError, OSError) as exc:
            raise SimulationError(
                "an environment's process has died; its message stands above. Training can be continued by "
                "the same command."
            ) from exc
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return answers


def _serve(pipe: Connection, settings: EnvSettings, n_slots: int) -> None:
    """Run one process's environments until the pipe is closed; an exception goes to the parent."""
    # Ctrl-C reaches the whole group: the parent decides, and closes the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        env = make_env(dataclasses.replace(settings, privileged=True, n_slots=n_slots))
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(1)
        pipe.send(None)  # ready
        with contextlib.closing(env), contextlib.suppress(EOFError):  # the parent is done, or has gone
            while True:
                command, values = pipe.recv()
                pipe.send(_answer(env, command, values, task=settings.task))
    except Exception as exc:
        pipe.send(exc)


def _answer(env: SimEnv, command: str, values: NDArray[Any], *, task: str) -> LockstepResult:
    rows = dict(enumerate(values))
    if command == "reset":
        results = env.reset({slot: int(seed) for slot, seed in rows.items()}, render=False)
    else:
        results = env.step(rows, render=frozenset())
    return _collect([results[slot] for slot in range(len(rows))], task)


def _collect(results: Sequence[StepResult], task: str) -> LockstepResult:
    worlds = [state for result in results if (state := result.observation.privileged) is not None]
    if len(worlds) != len(results) or not all(world.state_vector.size for world in worlds):
        raise SpecMismatchError(f"{task}: the environment offers no state vector to learn from.")
    return LockstepResult(
        np.stack([world.state_vector for world in worlds]),
        np.array([result.reward for result in results], dtype=np.float32),
        np.array([result.status.success for result in results]),
        np.array([distance_to_go_m(world) for world in worlds], dtype=np.float32),
    )


def distance_to_go_m(world: PrivilegedState) -> float:
    """Return how far the tool is from the right candidate, or from the ball and the ball from its goal."""
    if world.target is not None:
        return float(np.linalg.norm(world.candidate_positions_m[world.target] - world.tcp_position_m))
    ball, goal = world.bodies["ball"].position_m, world.bodies["goal"].position_m
    return float(np.linalg.norm(ball - world.tcp_position_m) + np.linalg.norm((goal - ball)[:2]))
