"""What one policy does to its process never changes another's result, and an episode never the next one's."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import Bench
from vla_eval.storage.run_folder import read_run

bench = evaluation_bench.bench

# One constructor per kind of leak: what it does stays for as long as its process lives.
LEAKS = {
    "float16": "import torch; torch.set_default_dtype(torch.float16)",
    "float64": "import torch; torch.set_default_dtype(torch.float64)",
    "device": "import torch; torch.set_default_device('meta')",
    "deterministic": "import torch; torch.use_deterministic_algorithms(True)",
    "threads": "import torch; torch.set_num_threads(3)",
    "no_grad": "import torch; torch.set_grad_enabled(False)",
    "autocast": "import torch; torch.autocast('cpu').__enter__()",
    "torch_seed": "import torch; torch.manual_seed(5)",
    "numpy_seed": "np.random.seed(5)",
    "random_seed": "import random; random.seed(5)",
    "environment": "os.environ.update(PATH='', HOME='/nowhere', TMPDIR='/nowhere', OMP_NUM_THREADS='9')",
    "directory": "os.chdir('/')",
    "handlers": "import signal; signal.signal(signal.SIGUSR1, signal.SIG_IGN); signal.alarm(2)",
    "warnings": "import warnings; warnings.simplefilter('error')",
    "path": "import sys; sys.path.clear(); sys.path_importer_cache.clear()",
    "numpy_patched": "np.random.default_rng = lambda *_: 1 / 0; np.clip = lambda a, *_, **__: a * 0",
    "locale": "import locale; locale.setlocale(locale.LC_ALL, 'C'); import time; time.tzset()",
    "umask": "os.umask(0o777)",
    "recursion": "import sys; sys.setrecursionlimit(120)",
    "stdout": "import sys; sys.stdout = sys.stderr = None",
    "no_gc": "import gc; gc.disable(); gc.freeze()",
    "logging": "import logging; logging.disable(); logging.raiseExceptions = False",
    "float_errors": "np.seterr(all='raise')",
    "exit_hook": "import atexit; from multiprocessing import util; hook = lambda: os._exit(9);"
    " atexit.register(hook); util.Finalize(None, hook, exitpriority=1)",
    "open_files": "import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (24, 24))",
    "file_size": "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))",
    "codec": "import codecs; codecs.register_error('strict', lambda error: ('', error.end))",
    "encoder": "import json; json.dumps = lambda *_, **__: '{}'",
    "rng_class": "import hashlib; hashlib.sha256 = hashlib.md5",
    "our_class": "import vla_eval.chunking as c; c.ChunkExecutor.action = lambda *_: None",
    "thread": "import threading; threading.Thread(target=__import__('time').sleep, args=(30,)).start()",
}
LEAKING_MODULE = """
import os
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

class Policy:
    def __init__(self, context):
        self.spec = PolicySpec(name="leak", reads="last", cameras=(), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
    def reset(self, episodes): pass
    def act(self, window):
        return ActionChunk(actions=np.zeros((self.spec.chunk_size, 7), dtype="float32"))

def make(context, *, leak):
    policy = Policy(context)
    exec(leak, globals())
    return policy
"""
# Draws from the generators that everybody shares, as careless policies do.
DRAWING_MODULE = """
import os, random
import numpy as np, torch
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

class Policy:
    def __init__(self, context):
        self.spec = PolicySpec(name="draws", reads="last", cameras=(), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.weights = torch.rand(7).numpy() + np.random.rand(7) + random.random()
    def reset(self, episodes): pass
    def act(self, window):
        drawn = torch.rand(self.spec.chunk_size, 7).numpy() + np.random.rand(7) + random.random()
        return ActionChunk(actions=(drawn - self.weights).astype("float32"))

def make(context):
    return Policy(context)
"""
# A list is an object that a collection walks through, unless it is frozen.
LOOKING_MODULE = LEAKING_MODULE.replace(
    "exec(leak, globals())",
    """
    policy.mine = [policy]
    def act(window):
        import gc
        if any(one is policy.mine for one in gc.get_objects()):
            raise RuntimeError("each reset walks through what the policy is made of")
        return Policy.act(policy, window)
    policy.act = act""",
).replace(", *, leak", "")
VICTIMS = ["cue_blind", "random"]


def write_recipe(folder: Path, name: str, adapter: str, **args: Any) -> str:
    recipe = {"version": 1, "description": "d", "adapter": adapter, "args": args}
    (folder / f"{name}.yaml").write_text(json.dumps(recipe))
    return str(folder / f"{name}.yaml")


def results(bench: Bench, out: str, policies: list[str]) -> list[str]:
    records = read_run(bench.folder / out).records
    return sorted(record.to_json() for record in records if record.policy in policies)


@pytest.mark.parametrize(
    ("workers", "victims_first"),
    [
        (1, False),
        pytest.param(2, False, marks=pytest.mark.slow),
        pytest.param(1, True, marks=pytest.mark.slow),
    ],
)
def test_thirty_kinds_of_leak_change_no_other_policy_s_records(
    bench: Bench, workers: int, victims_first: bool
) -> None:
    (bench.folder / "leaking_policy.py").write_text(LEAKING_MODULE)
    leaking = [write_recipe(bench.folder, name, "leaking_policy:make", leak=LEAKS[name]) for name in LEAKS]
    # First episodes come before all others: a victim that is named first has its second one after the leaks.
    order, episodes = ([*VICTIMS, *leaking], 2) if victims_first else ([*leaking, *VICTIMS], 1)
    bench.run("clean", policies=VICTIMS, episodes=episodes, env={})

    bench.run("out", policies=order, episodes=episodes, env={}, workers=workers, max_consecutive_errors=100)

    assert len(results(bench, "clean", VICTIMS)) == 2 * episodes
    assert results(bench, "out", VICTIMS) == results(bench, "clean", VICTIMS)


def test_draws_from_the_global_generators_depend_on_the_episode_alone(bench: Bench) -> None:
    (bench.folder / "drawing_policy.py").write_text(DRAWING_MODULE)
    drawing = write_recipe(bench.folder, "draws", "drawing_policy:make")
    bench.run("one", policies=[drawing], episodes=4, runs=2)
    bench.run("two", policies=[drawing, "random"], episodes=4, runs=2, workers=2)
    bench.run("late", policies=[drawing], episodes=2, runs=2, seed_start=3)

    lines = results(bench, "one", ["draws"])
    assert len(set(lines)) == 8
    assert results(bench, "two", ["draws"]) == lines
    assert set(results(bench, "late", ["draws"])) <= set(lines)


def test_a_collection_during_episodes_does_not_walk_through_the_policy(bench: Bench) -> None:
    (bench.folder / "looking_policy.py").write_text(LOOKING_MODULE)
    bench.run("out", policies=[write_recipe(bench.folder, "looks", "looking_policy:make")], episodes=2)

    records = read_run(bench.folder / "out").records
    assert [record.error for record in records] == [None, None]
