"""Measure whole evaluations, start-up included, against the official runner or our own eager loop.

Each is a command of its own, as a user starts it. What one step, one frame and one reset cost is measured in
this process; from that follows the floor, which an evaluation with these frames cannot be faster than.
"""

import contextlib
import json
import math
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import vla_eval.bench.official_episodes as official_script
from vla_eval.bench.parts import measure_parts
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import describe_env
from vla_eval.errors import ConformanceError
from vla_eval.lock.switch import own_need
from vla_eval.storage.folders import EPISODES_FILE
from vla_eval.testing.looking_policy import make_looking, write_recipe
from vla_eval.workers.children import bound_command, python_command
from vla_eval.workers.guard import become_subreaper
from vla_eval.workers.start import available_cores

POLL_SECONDS = 0.02


class Costs(NamedTuple):
    """CPU milliseconds in one process, with nothing else running."""

    step_ms: float
    frame_ms: float
    reset_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Baseline:
    """One process that renders every step."""

    name: str
    n_steps: int  # control steps after its first episode
    seconds: float  # for these
    cpu_seconds: float | None  # for these; None: not measured
    start_seconds: float  # until its first episode would have begun: the rest of the first one's time

    @property
    def per_second(self) -> float:
        """Control steps per second once it runs."""
        return self.n_steps / self.seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationRow:
    """One evaluation at one chunk length."""

    n_action_steps: int
    # `n_steps`, `n_frames`: control steps and rendered observations of all episodes
    n_steps: int
    n_frames: int
    seconds: float  # from the command to its end
    first_seconds: float  # from the command to the first record
    cpu_seconds: float  # of all its processes
    floor_seconds: float  # steps and frames, spread evenly over the workers


@dataclass(frozen=True, slots=True, kw_only=True)
class OfficialReport:
    """What one run measured; `load` is how many processes wanted a core when it began."""

    task: str
    n_workers: int
    n_episodes: int
    load: float
    costs: Costs
    baseline: Baseline
    rows: tuple[EvaluationRow, ...]

    def ratio(self, row: EvaluationRow) -> float:
        """How many times as many steps per second, our start-up counted and the baseline's not."""
        return row.n_steps / row.seconds / self.baseline.per_second

    def ratio_with_both_starts(self, row: EvaluationRow) -> float:
        """The same with the baseline's start-up counted, too."""
        theirs = self.baseline.start_seconds + row.n_steps / self.baseline.per_second
        return theirs / row.seconds


def run_official_bench(
    task: str,
    *,
    python: Path | None,
    chunk_lengths: Sequence[int],
    n_workers: int,
    n_episodes: int,
    n_baseline_episodes: int,
) -> OfficialReport:
    """Measure our evaluations, and a baseline, of which the first episode is only for its start-up.

    The official package, of which `python` is the environment's interpreter, has the task as `…-VLA-v0`.
    Without one, our own eager loop is the baseline.
    """
    load = os.getloadavg()[0]
    step_ms, _, frame_ms, _, seen_reset_ms = (part.cpu_ms for part in measure_parts(task, repeats=1))
    costs = Costs(step_ms, frame_ms, seen_reset_ms - frame_ms)
    horizon_steps = describe_env(EnvSettings(task=task)).horizon_steps
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if python is None:
            baseline = _eager(task, folder, n_baseline_episodes, horizon_steps)
        else:
            baseline = _official(task, python, n_baseline_episodes, horizon_steps)
        rows = tuple(
            _row(task, folder, k, costs, horizon_steps, n_workers=n_workers, n_episodes=n_episodes)
            for k in chunk_lengths
        )
    return OfficialReport(
        task=task,
        n_workers=n_workers,
        n_episodes=n_episodes,
        load=load,
        costs=costs,
        baseline=baseline,
        rows=rows,
    )


def _row(
    task: str, folder: Path, k: int, costs: Costs, horizon_steps: int, *, n_workers: int, n_episodes: int
) -> EvaluationRow:
    ran = _evaluation(task, folder, f"k{k}", k, n_episodes, "--workers", str(n_workers))
    n_frames = n_episodes * math.ceil(horizon_steps / k)
    n_steps = n_episodes * horizon_steps
    work_ms = n_steps * costs.step_ms + n_frames * costs.frame_ms
    return EvaluationRow(
        n_action_steps=k,
        n_steps=n_steps,
        n_frames=n_frames,
        seconds=ran.seconds,
        first_seconds=ran.record_seconds[0],
        cpu_seconds=ran.cpu_seconds,
        floor_seconds=work_ms / 1000 / min(n_workers, available_cores()),
    )


class _Ran(NamedTuple):
    """When a command wrote each record, when it ended, and the CPU time of all its processes; s."""

    record_seconds: list[float]
    seconds: float
    cpu_seconds: float


def _evaluation(task: str, folder: Path, name: str, k: int, n_episodes: int, *flags: str) -> _Ran:
    """Run an evaluation of the policy that reads both cameras, in a run folder of its own."""
    out = folder / name
    policy = write_recipe(folder / "looking.yaml", make_looking)
    command = python_command("-m", "vla_eval.cli", "eval", "--task", task, "--policy", policy)
    command += ["--n-action-steps", str(k), "--episodes", str(n_episodes), "--out", str(out), *flags]
    become_subreaper()  # so that the CPU time of processes that outlive the command is counted
    records = out / EPISODES_FILE
    cpu, begun = _children_seconds(), time.perf_counter()
    times: list[float] = []
    with tempfile.TemporaryFile("w+") as output:
        with own_need():
            process = subprocess.Popen(command, stdout=output, stderr=output)
        while process.poll() is None:
            time.sleep(POLL_SECONDS)
            n_records = records.read_bytes().count(b"\n") if records.exists() else 0
            times += [time.perf_counter() - begun] * (n_records - len(times))
        seconds = time.perf_counter() - begun
        if process.returncode or not times:
            output.seek(0)
            raise ConformanceError(f"bench: the evaluation failed: {output.read()[-2000:]}")
    with contextlib.suppress(ChildProcessError):  # none is left
        while True:
            os.wait()
    return _Ran(times, seconds, _children_seconds() - cpu)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _eager(task: str, folder: Path, n_episodes: int, horizon_steps: int) -> Baseline:
    flags = ("--workers", "1", "--set", "eager_rendering=true", "--set", "render.wrist_mesh=whole")
    times = _evaluation(task, folder, "eager", 1, n_episodes, *flags).record_seconds
    each = (times[-1] - times[0]) / (n_episodes - 1)
    return Baseline(
        name="our own loop, eager, with the whole mesh",
        n_steps=horizon_steps * (n_episodes - 1),
        seconds=times[-1] - times[0],
        cpu_seconds=None,
        start_seconds=times[0] - each,
    )


def _official(task: str, python: Path, n_episodes: int, horizon_steps: int) -> Baseline:
    script = Path(official_script.__file__)
    arguments = (str(script), task.replace("-v0", "-VLA-v0"), str(horizon_steps), str(n_episodes))
    # Without our own path: the other environment has its own packages.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    begun = time.perf_counter()
    command = bound_command(str(python), *arguments)
    with own_need():
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
    seconds = time.perf_counter() - begun
    if done.returncode:
        raise ConformanceError(
            f"bench: the official runner failed in {python}; docs/speed.md says how to install it. "
            f"The end of its output: {done.stderr[-2000:]}"
        )
    found = json.loads(done.stdout.splitlines()[-1])
    running = found["seconds"][-1] - found["seconds"][0]
    return Baseline(
        name="the official runner",
        n_steps=sum(found["n_steps"][1:]),
        seconds=running,
        cpu_seconds=found["cpu_seconds"][-1] - found["cpu_seconds"][0],
        start_seconds=seconds - running * n_episodes / (n_episodes - 1),
    )
