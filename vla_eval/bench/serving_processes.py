"""Start what is measured: a policy server, or copies of the policy, each in processes of its own."""

import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from queue import Empty
from typing import Any

import numpy as np
import psutil
import torch

from vla_eval.chunking import ChunkingSpec
from vla_eval.core import EpisodeStart, FloatArray, Observation, ObservationWindow, Policy, infer
from vla_eval.errors import RemotePolicyError
from vla_eval.lock.switch import own_need
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.policies.registry import make_from_adapter
from vla_eval.policies.remote.policy import RemotePolicy, make_remote
from vla_eval.tasks.interface import env_spec
from vla_eval.workers.children import python_command
from vla_eval.workers.start import child_context

INSTRUCTION = "look and move"
N_OBSERVATIONS = 16  # drawn once; a policy is shown them in turn
IMAGE_PX = 128
STATE_SIZES = {"tcp_pose": 7, "qpos": 9, "qvel": 9}
START_SECONDS = 900.0  # importing torch, and loading the weights
STOP_SECONDS = 30.0
REPLY_SECONDS = 300.0
SERVING = re.compile(r"at (ws://\S+)")


class Asker:
    """One episode of a policy, shown random images (by seed), one inference after the other.

    The policy is asked by nobody else at the same time, unless it is for the same thread.
    """

    def __init__(self, policy: Policy, *, seed: int = 0, row: int = 0) -> None:
        self._policy, self._row = policy, row
        draws = np.random.default_rng(seed)
        self._drawn = [_drawn(draws) for _ in range(N_OBSERVATIONS)]
        self._step = 0
        start = EpisodeStart(
            slot=0, task="bench", seed=seed, run=0, instruction=INSTRUCTION, horizon_steps=10**6, row=row
        )
        policy.reset([start])

    def ask(self) -> FloatArray:
        """Return the actions (T, A) for the next observation."""
        drawn = self._drawn[self._step % N_OBSERVATIONS]
        spec = self._policy.spec
        frame = Observation(
            step=self._step,
            images={name: image for name, image in drawn.images.items() if name in spec.cameras},
            state={name: drawn.state[name] for name in spec.states},
        )
        self._step += 1
        return infer(self._policy, [ObservationWindow(slot=0, frames=(frame,))])[0].actions


def _drawn(draws: np.random.Generator) -> Observation:
    pose = np.array([0, 0, 0.2, 0, 1, 0, 0], np.float32)
    pose[:3] += draws.normal(0, 0.05, 3).astype(np.float32)
    state = {name: draws.normal(0, 0.1, n).astype(np.float32) for name, n in STATE_SIZES.items()}
    return Observation(
        step=0,
        images={
            name: draws.integers(0, 256, (IMAGE_PX, IMAGE_PX, 3), dtype=np.uint8)
            for name in ("base_camera", "hand_camera")
        },
        state={**state, "tcp_pose": pose},
    )


def context(name: str, *, n_rows: int) -> PolicyContext:
    """Return what a policy of this name is made for: any task, so many rows of a pass."""
    chunking = ChunkingSpec(n_action_steps=1)
    return PolicyContext(name=name, env=env_spec(), chunking=chunking, n_candidates=0, n_slots=n_rows)


def make_in_process(policy: str, *, n_rows: int, **args: Any) -> Policy:
    """Make the policy of a recipe in this process; `args` replace those of the recipe."""
    recipe = load_policy_recipe(policy)
    made = {**recipe.value.args, **args}
    return make_from_adapter(recipe.value.adapter, context(recipe.name, n_rows=n_rows), made)


@dataclass(frozen=True, slots=True, kw_only=True)
class Server:
    """A policy server in a process of its own."""

    url: str
    pid: int
    said: str  # before it was ready

    def connect(self) -> RemotePolicy:
        """Return the policy behind it, with one session on a connection of its own."""
        return make_remote(context("served", n_rows=1), url=self.url, timeout_seconds=REPLY_SECONDS)


@contextmanager
def serving(policy: str, *, n_rows: int, compiles: bool = False) -> Iterator[Server]:
    """Serve a policy on a free port, end the server afterwards; `RemotePolicyError` if it does not start."""
    command = python_command("-m", "vla_eval.cli", "serve", "--policy", policy)
    command += ["--port", "0", "--max-batch", str(n_rows), *(["--compile"] if compiles else [])]
    with tempfile.TemporaryFile("w+") as errors:
        with own_need():
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            assert process.stdout is not None  # it is a pipe
            said, found = "", None
            for line in process.stdout:
                found = SERVING.search(line)
                if found:
                    break
                said += line
            if found is None:
                process.wait(STOP_SECONDS)
                errors.seek(0)
                raise RemotePolicyError(f"bench: the server of '{policy}' ended: {errors.read()[-2000:]}")
            yield Server(url=found.group(1), pid=process.pid, said=said.strip())
        finally:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What was measured of something that infers."""

    per_second: float
    resident_bytes: int  # memory of its processes
    device_bytes: int | None  # memory of the GPU that they took; None: there is none


def measure_copies(policy: str, *, n_copies: int, seconds: float) -> Load:
    """Let so many processes infer, each with a copy and one thread; `RemotePolicyError` if one ends."""
    spawn = child_context()
    free_before = free_device_bytes()
    barrier, results = spawn.Barrier(n_copies), spawn.Queue()
    processes = [
        spawn.Process(target=_infer_alone, args=(policy, seconds, index, barrier, results), daemon=True)
        for index in range(n_copies)
    ]
    for process in processes:
        process.start()
    try:
        found = [results.get(timeout=START_SECONDS + seconds) for _ in processes]
        on_device = taken_bytes(free_before)
    except Empty as exc:
        raise RemotePolicyError(
            f"bench: a copy of '{policy}' gave no result; see its message above."
        ) from exc
    finally:
        for process in processes:
            process.terminate()
            process.join()
    return Load(
        per_second=sum(per_second for per_second, _ in found),
        resident_bytes=sum(resident for _, resident in found),
        device_bytes=on_device,
    )


def _infer_alone(policy: str, seconds: float, seed: int, barrier: Barrier, results: Any) -> None:
    torch.set_num_threads(1)
    asker = Asker(make_in_process(policy, n_rows=1), seed=seed)
    asker.ask()
    barrier.wait(START_SECONDS)
    n, begun = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < seconds:
        asker.ask()
        n += 1
    results.put((n / elapsed, psutil.Process().memory_info().rss))
    time.sleep(START_SECONDS)  # until it is ended: the memory of all is measured while all are there


def free_device_bytes() -> int | None:
    """Return the free memory of the GPU; None if there is none."""
    return int(torch.cuda.mem_get_info()[0]) if torch.cuda.is_available() else None


def taken_bytes(free_before: int | None) -> int | None:
    """Return how much less memory of the GPU is free now than before; None if there is no GPU."""
    free = free_device_bytes()
    return None if free is None or free_before is None else free_before - free
