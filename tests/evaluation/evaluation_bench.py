"""A bench for whole runs on the fake simulator: policies that go wrong when told to, and what they left."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.resolved import evaluate
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.evaluation.evaluate import EvaluationSummary
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.strict.decoding import decode

TASK = "RememberColor3-v0"
SHORT = {"horizon_steps": 12, "cue_steps": 1, "delay_steps": 1}  # so that an episode takes a millisecond

# A policy that does, at the seeds it is told to, what policies and machines do at night. A file named
# `mended` beside it makes it behave: as if its author had corrected it, the recipe being the same.
POLICY_MODULE = """
import os, signal, sys, time
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.errors import SpecMismatchError
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent


class Policy:
    def __init__(self, context, faults, pause, cameras):
        (HERE / f"pid-{os.getpid()}").touch()
        if faults.get("setup") and not (HERE / "mended").exists():
            self.fault(faults["setup"])
        self.spec = PolicySpec(name="whatever", reads="last", cameras=tuple(cameras), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.faults, self.pause, self.seed = faults, pause, None

    def reset(self, episodes):
        (episode,) = episodes
        self.seed, self.run = episode.seed, episode.run
        self.rng = np.random.default_rng([episode.seed, episode.run])

    def act(self, window):
        time.sleep(self.pause)
        fault = self.faults.get(str(self.seed))
        if fault and window.last.step >= 2 and not (HERE / "mended").exists():
            answer = self.fault(fault)
            if answer is not None:
                return answer
        drawn = self.rng.uniform(-1, 1, (self.spec.chunk_size, 7))
        return ActionChunk(actions=drawn.astype(np.float32))

    def fault(self, kind):
        shape = (self.spec.chunk_size, 7) if kind in ("nan", "shape") else None
        if kind == "exit":
            print("these are my last words", file=sys.stderr, flush=True)
            os._exit(7)
        if kind == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if kind == "hang":
            time.sleep(1000)
        if kind == "sysexit":
            sys.exit("bye")
        if kind == "refuse once it has run" and (HERE / "ran").exists():
            raise SpecMismatchError("the GPU is gone")
        if kind == "refuse once it has run":
            return
        (HERE / "ran").touch()
        if kind == "raise":
            raise ZeroDivisionError("a mistake in the policy")
        if kind == "nan":
            return ActionChunk(actions=np.full(shape, np.nan, dtype=np.float32))
        if kind == "shape":
            return ActionChunk(actions=np.zeros((shape[0], 6), dtype=np.float32))


def make(context, *, faults={}, pause=0.0, cameras=()):
    return Policy(context, faults, pause, cameras)
"""

# Counts its inferences and draws numbers, each slot its own: what would show if episodes mixed.
PAIR_MODULE = """
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent


class Policy:
    def __init__(self, context, fails_at):
        self.spec = PolicySpec(name="pair", reads="last", cameras=(), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.fails_at, self.slots = fails_at, {}

    def reset(self, episodes):
        with (HERE / "rows").open("a") as file:
            file.write(" ".join(f"{e.seed}:{e.row}" for e in episodes) + "\\n")
        for e in episodes:
            self.slots[e.slot] = {"seed": e.seed, "n": 0, "rng": np.random.default_rng([e.seed, e.run])}

    def act_batch(self, windows):
        with (HERE / "passes").open("a") as file:
            file.write(f"{len(windows)} ")
        return [self.act(window) for window in windows]

    def act(self, window):
        slot = self.slots[window.slot]
        slot["n"] += 1
        if slot["seed"] == self.fails_at and not (HERE / "mended").exists():
            raise ZeroDivisionError("a mistake in the policy")
        actions = slot["rng"].uniform(-1, 1, (self.spec.chunk_size, 7)).astype(np.float32)
        actions[:, 0] = 0.1 * slot["n"]
        return ActionChunk(actions=actions)


def make(context, *, fails_at=None):
    return Policy(context, fails_at)
"""


class Bench:
    """A folder with the policy's module, its recipe, and what is needed to run it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "night_policy.py").write_text(POLICY_MODULE)
        (folder / "pair_policy.py").write_text(PAIR_MODULE)
        self.write_policy()

    def write_policy(self, adapter: str = "night_policy:make", *, name: str = "night", **args: Any) -> Path:
        recipe = {"version": 1, "description": "d", "adapter": adapter, "args": args}
        path = self.folder / f"{name}.yaml"
        path.write_text(json.dumps(recipe))  # JSON is YAML
        return path

    def mend(self) -> None:
        (self.folder / "mended").touch()

    def config(self, **fields: Any) -> EvalConfig:
        data = {
            "name": "test",
            "tasks": [TASK],
            "policies": [str(self.folder / "night.yaml")],
            "episodes": 6,
            "simulator": "fake",
            "env": SHORT,
            "workers": 1,
            **fields,
        }
        return decode(EvalConfig, data, where="test")

    def run(self, out: str, **fields: Any) -> EvaluationSummary:
        return evaluate(self.config(**fields), out=self.folder / out)

    def records(self, out: str) -> dict[int, EpisodeRecord]:
        return {record.seed: record for record in read_run(self.folder / out).records}

    def lines(self, out: str) -> list[str]:
        """Return the lines of all results, sorted; those of errors are left out."""
        lines = (self.folder / out / "episodes.jsonl").read_text().splitlines()
        return sorted(line for line in lines if '"outcome": "error"' not in line)

    def worker_pids(self) -> set[int]:
        return {int(path.name.removeprefix("pid-")) for path in self.folder.glob("pid-*")}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.syspath_prepend(tmp_path)  # spawned workers get the parent's path
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)  # and so do command lines
    monkeypatch.setattr(evaluate_module, "collect_environment", lambda: {"machine": "test"})
    return Bench(tmp_path)
