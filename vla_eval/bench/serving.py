"""Measure a policy behind a socket against the same policy in a process: latency, rate, memory, rounding.

Every figure is of one run on one machine. Servers and copies run one after the other, each in processes of
its own, as in an evaluation.
"""

import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import torch

from vla_eval.bench.serving_processes import (
    Asker,
    Load,
    Server,
    free_device_bytes,
    make_in_process,
    measure_copies,
    serving,
    taken_bytes,
)
from vla_eval.core import FloatArray
from vla_eval.testing.looking_policy import write_recipe
from vla_eval.testing.serving_policies import make_small_transformer, make_still, write_small_transformer

N_COMPARED = 4  # inferences per episode whose actions are compared
MIN_LATENCIES = 20
SMALL = "small transformer"


class Percentiles(NamedTuple):
    """Milliseconds."""

    p50: float
    p99: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionsRow:
    """So many sessions of one server, against so many copies."""

    n_sessions: int
    served: Load
    compiled: Load | None  # the same with a compiled network; None: it was not asked for
    n_copies: int  # processes with a copy each; no more than there are cores
    copies: Load


class Rounding(NamedTuple):
    """How far actions of a pass with B rows are from those of a pass with one."""

    precision: str
    n_rows: int
    largest: float
    scale: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ServingReport:
    """What one run measured."""

    policy: str
    n_parameters: int | None  # of the small transformer; None for a policy that was named
    n_cores: int
    device: str | None  # name of the GPU; None: there is none
    load: float  # processes that wanted a core before the first measurement, see `os.getloadavg`
    n_latencies: int  # inferences of which latencies are percentiles
    direct: Percentiles  # milliseconds of an inference in the process, of a policy that computes nothing
    served: Percentiles  # the same behind a socket
    rows: tuple[SessionsRow, ...]
    rounding: tuple[Rounding, ...]
    compilation: str  # the server's line about its compiled network; empty: it was not asked for

    @property
    def added(self) -> Percentiles:
        """Milliseconds that the socket adds."""
        return Percentiles(self.served.p50 - self.direct.p50, self.served.p99 - self.direct.p99)


def run_serving_bench(
    policy: str | None, *, sessions: Sequence[int], seconds: float, compiles: bool = False
) -> ServingReport:
    """Measure each number of sessions, and each rate for these seconds; `compiles`: also compiled.

    The policy is a recipe, its file or a checkpoint's folder; None: a small transformer with random weights.
    `RemotePolicyError`: a server or a copy does not start.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder, n_parameters = Path(scratch), None
        still = write_recipe(folder / "still.yaml", make_still)
        served = policy
        if served is None:
            n_parameters = write_small_transformer(folder / "small")
            small = str(folder / "small")
            served = write_recipe(folder / "small.yaml", make_small_transformer, checkpoint=small)
        load = os.getloadavg()[0]
        direct, behind, n_latencies = _latencies(still, seconds)
        rows = [_row(served, n, seconds, compiles=compiles) for n in sessions]
        precisions: tuple[str | None, ...] = ("float32", "bfloat16") if policy is None else (None,)
        return ServingReport(
            policy=SMALL if policy is None else policy,
            n_parameters=n_parameters,
            n_cores=len(os.sched_getaffinity(0)),
            device=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
            load=load,
            n_latencies=n_latencies,
            direct=direct,
            served=behind,
            rows=tuple(row for row, _ in rows),
            rounding=tuple(_rounding(served, max(sessions), precision) for precision in precisions),
            compilation=rows[-1][1],
        )


def _latencies(policy: str, seconds: float) -> tuple[Percentiles, Percentiles, int]:
    """Return the latencies in this process and behind a socket, and of how many inferences each."""
    with serving(policy, n_rows=1) as server:
        remote = server.connect()
        askers = (Asker(make_in_process(policy, n_rows=1)), Asker(remote))
        for asker in askers:
            for _ in range(MIN_LATENCIES):  # the first ones connect, allocate and import
                asker.ask()
        taken: tuple[list[float], list[float]] = ([], [])
        end = time.perf_counter() + seconds
        while time.perf_counter() < end or len(taken[0]) < MIN_LATENCIES:
            for asker, times in zip(askers, taken, strict=True):  # in turn: the machine's load is the same
                begun = time.perf_counter()
                asker.ask()
                times.append(1000 * (time.perf_counter() - begun))
        remote.close()
    direct, served = (Percentiles(*np.percentile(times, [50, 99]).tolist()) for times in taken)
    return direct, served, len(taken[0])


def _row(policy: str, n_sessions: int, seconds: float, *, compiles: bool) -> tuple[SessionsRow, str]:
    """Return the row, and the server's line about its compiled network."""
    free_before = free_device_bytes()
    with serving(policy, n_rows=n_sessions) as server:
        served = _served_rate(server, n_sessions, seconds, free_before)
    compiled, said = None, ""
    if compiles:
        with serving(policy, n_rows=n_sessions, compiles=True) as server:
            compiled, said = _served_rate(server, n_sessions, seconds, free_before), server.said
    n_copies = min(n_sessions, len(os.sched_getaffinity(0)))
    copies = measure_copies(policy, n_copies=n_copies, seconds=seconds)
    row = SessionsRow(
        n_sessions=n_sessions, served=served, compiled=compiled, n_copies=n_copies, copies=copies
    )
    return row, said


def _served_rate(server: Server, n_sessions: int, seconds: float, free_before: int | None) -> Load:
    """Let so many sessions ask, each again as soon as it has its answer."""
    policies = [server.connect() for _ in range(n_sessions)]
    askers = [Asker(policy, seed=row, row=row) for row, policy in enumerate(policies)]

    def ask_until(asker: Asker, end: float) -> int:
        n = 0
        while time.perf_counter() < end:
            asker.ask()
            n += 1
        return n

    try:
        with ThreadPoolExecutor(n_sessions) as pool:
            list(pool.map(Asker.ask, askers))  # the first ones connect
            begun = time.perf_counter()
            n_asked = sum(pool.map(ask_until, askers, repeat(begun + seconds)))
        elapsed = time.perf_counter() - begun
        resident, on_device = psutil.Process(server.pid).memory_info().rss, taken_bytes(free_before)
    finally:
        for policy in policies:
            policy.close()
    return Load(per_second=n_asked / elapsed, resident_bytes=resident, device_bytes=on_device)


def _rounding(policy: str, n_rows: int, precision: str | None) -> Rounding:
    """Compare the actions of a pass with so many rows to those of passes with one."""
    args = {} if precision is None else {"dtype": precision}
    alone = make_in_process(policy, n_rows=1, **args)
    together = make_in_process(policy, n_rows=n_rows, **args)
    largest = scale = 0.0
    for row in range(n_rows):
        first = _actions(Asker(alone, seed=row, row=0))
        second = _actions(Asker(together, seed=row, row=row))
        largest = max(largest, float(np.abs(second - first).max()))
        scale = max(scale, float(np.abs(first).max()))
    name = "as its recipe says" if precision is None else precision
    return Rounding(precision=name, n_rows=n_rows, largest=largest, scale=scale)


def _actions(asker: Asker) -> FloatArray:
    return np.stack([asker.ask() for _ in range(N_COMPARED)])
