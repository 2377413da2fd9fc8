"""The slots of one environment in several processes, a block of slots each: a `SimEnv` like another.

Episodes are functions of their seeds and actions, so no result depends on the number of processes.
"""

import functools
import gc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vla_eval.config.environment import EnvSettings
from vla_eval.core import FloatArray, SimEnv, StepResult
from vla_eval.envs.factory import describe_env, make_env, slow_modules
from vla_eval.errors import SimulationError
from vla_eval.lock.switch import let_write
from vla_eval.workers.framing import BrokenMessageError
from vla_eval.workers.inside import Heartbeat, RunnerClass, worker_main
from vla_eval.workers.messages import Failed, Notice, describe_error
from vla_eval.workers.process import WorkerProcess
from vla_eval.workers.start import available_cores, worker_context

RUNNER = "vla_eval.agents.simulators:SimulatorRunner"
LOGS_FOLDER = "logs"
TICK_SECONDS = 1.0
MAX_SECONDS = 600.0  # for a start, a reset or a step of all slots


@dataclass(frozen=True, slots=True, kw_only=True)
class _Request:
    """What a process is to do with its slots, which it counts from 0."""

    what: Literal["reset", "step", "hold"]
    given: Mapping[int, Any]  # seeds, or actions
    render: frozenset[int]


class SimulatorRunner:
    """The inside of a process."""

    def __init__(
        self, heartbeat: Heartbeat, tell: Callable[[Notice], None], *, settings: EnvSettings
    ) -> None:
        self._heartbeat, self._settings = heartbeat, settings
        self._env: SimEnv | None = None

    def answer(self, job: _Request) -> object:
        """Return the results by slot; whatever goes wrong becomes a `Failed`."""
        try:
            if self._env is None:
                self._env = make_env(self._settings)
                gc.freeze()  # ManiSkill collects garbage at each reset
            if job.what == "hold":
                return {slot: self._env.hold_action(slot) for slot in job.given}
            if job.what == "reset":
                return self._env.reset(job.given, render=bool(job.render))
            return self._env.step(job.given, render=job.render)
        except BaseException as exc:  # the parent raises it
            return Failed(error=describe_error(exc, self._heartbeat.stage), refused=False)

    def close(self) -> None:
        """Release the simulator."""
        if self._env is not None:
            self._env.close()


class Simulators:
    """Processes with a block of slots each; they start with the first reset.

    Raises:
        SimulationError: a simulator failed, or its process ended.
    """

    def __init__(self, settings: EnvSettings, *, n_processes: int, logs: Path) -> None:
        self.spec = describe_env(settings)
        blocks = np.array_split(np.arange(settings.n_slots), n_processes)
        self._first_slots = [int(block[0]) for block in blocks]
        self._block_of = {int(slot): index for index, block in enumerate(blocks) for slot in block}
        context = worker_context(preload=slow_modules([settings]))
        let_write(logs)
        logs.mkdir(parents=True, exist_ok=True)
        self._processes = [
            WorkerProcess(
                functools.partial(
                    worker_main,
                    RunnerClass(target=RUNNER, options={"settings": replace(settings, n_slots=len(block))}),
                ),
                context,
                index=index,
                log=logs / f"simulator-{index}.log",
            )
            for index, block in enumerate(blocks)
        ]
        self._are_started = [False] * n_processes

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the given slots; see `SimEnv.reset`."""
        return self._ask("reset", seeds, frozenset(seeds if render else ()))

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one control step in each of the given slots; see `SimEnv.step`."""
        return self._ask("step", actions, render)

    def hold_action(self, slot: int) -> FloatArray:
        """Return the (A,) action that moves nothing; see `SimEnv.hold_action`."""
        found: FloatArray = self._ask("hold", {slot: None}, frozenset())[slot]
        return found

    def close(self) -> None:
        """Release the simulators, and end their processes."""
        for process in self._processes:
            process.ask_to_close()
        for process in self._processes:
            process.wait(TICK_SECONDS)
            process.end()

    def _ask(
        self, what: Literal["reset", "step", "hold"], given: Mapping[int, Any], render: frozenset[int]
    ) -> dict[int, Any]:
        asked: dict[int, dict[int, Any]] = {}
        for slot, value in given.items():
            asked.setdefault(self._block_of[slot], {})[slot - self._first_slots[self._block_of[slot]]] = value
        for index, own in asked.items():
            first = self._first_slots[index]
            self._give(
                index,
                _Request(what=what, given=own, render=frozenset(k for k in own if k + first in render)),
            )
        answers = self._answers(set(asked))
        return {
            slot + self._first_slots[index]: result
            for index, results in sorted(answers.items())
            for slot, result in results.items()
        }

    def _give(self, index: int, request: _Request) -> None:
        if self._are_started[index]:
            try:
                self._processes[index].connection.send(request)
            except OSError as exc:
                raise self._ended(index) from exc
        else:
            self._are_started[index] = True
            self._processes[index].give(request)

    def _answers(self, missing: set[int]) -> dict[int, dict[int, Any]]:
        found: dict[int, dict[int, Any]] = {}
        n_ticks = 0
        while missing:
            waited = {index: self._processes[index].connection for index in sorted(missing)}
            ready = wait(list(waited.values()), timeout=TICK_SECONDS)
            n_ticks = 0 if ready else n_ticks + 1
            for index in sorted(missing):
                error = self._processes[index].start_error
                if error is not None:
                    raise SimulationError(f"simulator {index}: its process cannot be started ({error}).")
                if n_ticks * TICK_SECONDS > MAX_SECONDS:
                    raise SimulationError(
                        f"simulator {index}: no answer after {MAX_SECONDS:g} s. {self._where(index)}"
                    )
            for index in [index for index, connection in waited.items() if connection in ready]:
                for answer in self._read(index):
                    found[index] = self._checked(index, answer)
                    missing.discard(index)
        return found

    def _read(self, index: int) -> list[object]:
        try:
            return self._processes[index].read()
        except (EOFError, ConnectionResetError, BrokenMessageError) as exc:
            raise self._ended(index) from exc

    def _checked(self, index: int, answer: object) -> dict[int, Any]:
        if isinstance(answer, Failed):
            raise SimulationError(
                f"simulator {index}: {answer.error.kind}: {answer.error.message} {self._where(index)}"
            )
        assert isinstance(answer, dict)
        return answer

    def _ended(self, index: int) -> SimulationError:
        code = self._processes[index].wait(TICK_SECONDS)
        return SimulationError(
            f"simulator {index}: its process ended (exit code {code}), as for lack of memory. "
            f"{self._where(index)}"
        )

    def _where(self, index: int) -> str:
        return f"More is in {self._processes[index].log}. The same command resumes the training."


def simulators(
    settings: EnvSettings, *, workers: int | Literal["auto"], is_robot: bool, logs: Path
) -> SimEnv:
    """Return the environment of a training; `auto`: a process per core for a robot's, else in this one.

    A robot's is never in this one: SAPIEN can abort while its process ends (a Python object is freed without
    the interpreter's lock), and a finished training would then look like one that failed.
    """
    has_physics = is_robot and settings.simulator != "fake"
    wanted = (available_cores() if has_physics else 1) if workers == "auto" else workers
    if settings.sim_backend == "gpu":  # one environment holds all slots
        wanted = 1
    n_processes = min(wanted, settings.n_slots)
    if n_processes == 1 and not has_physics:
        return make_env(settings)
    return Simulators(settings, n_processes=n_processes, logs=logs)
