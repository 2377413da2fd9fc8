"""How many records per second can the driver of an evaluation take? Measured with workers that only sleep.

The driver is the real one: plan, queue, Ray calls, checks of each record, run folder on the disk. Many
sleeping workers share a few processes, so that their own cost does not count. One line per number of workers:

    python scripts/driver_throughput.py --workers 8 64 512 --seconds 0.2 --records 20000
"""

import argparse
import asyncio
import resource
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any  # Ray is optional

from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.evaluate import evaluate
from vla_eval.evaluation.job_queue import EpisodeBatch
from vla_eval.evaluation.resolve import resolve
from vla_eval.evaluation.worker import Finished
from vla_eval.records import EpisodeRecord, EpisodeTiming
from vla_eval.storage.run_folder import RunFolder
from vla_eval.workers.cluster.backend import ClusterBackend
from vla_eval.workers.cluster.connect import connected
from vla_eval.workers.cluster.machines import Machine, Machines
from vla_eval.workers.cluster.pool import ClusterPool
from vla_eval.workers.load import Load

WORKERS_PER_PROCESS = 256
STEPS = 60
MB = 1 << 20


class Sleepers:
    """Many workers that sleep, in one process."""

    async def ready(self) -> None:
        """Return once the process is there."""

    async def do(self, jobs: Sequence[EpisodeBatch], seconds: float) -> list[Finished]:
        """Answer as a worker would, after a nap."""
        await asyncio.sleep(seconds * len(jobs))
        return [_finished(batch, seconds) for batch in jobs]

    async def close(self) -> None:
        """Keep nothing."""


def _finished(batch: EpisodeBatch, seconds: float) -> Finished:
    (job,) = batch.jobs
    record = EpisodeRecord(
        **job.key._asdict(),
        outcome="failure",
        success_once=False,
        success_at_end=False,
        n_steps=STEPS,
        target=job.seed % 3,
        n_candidates=3,
        first_choice_success=False,
        n_wrong_choices=0,
        chance_success=1 / 3,
        episode_return=0.0,
        n_inferences=STEPS,
        n_frames=STEPS,
        n_clipped_steps=0,
        trajectory_sha256=f"{job.seed:064x}",
        tcp_reach_m=0.1,
    )
    timing = EpisodeTiming(
        key=job.key, total_seconds=seconds, reset_seconds=0.0, step_seconds=seconds, inference_seconds=0.0
    )
    return Finished(records=(record,), timings=(timing,))


class Call:
    """A method of a sleeper, as Ray's handles have it."""

    def __init__(self, method: Any, *args: Any) -> None:
        self._method, self._args = method, args

    def remote(self, *args: Any) -> Any:
        """Call it."""
        return self._method.remote(*args, *self._args)


class Sleeper:
    """One worker: a share of a process."""

    def __init__(self, actor: Any, seconds: float) -> None:
        self.ready, self.close = Call(actor.ready), Call(actor.close)
        self.do = Call(actor.do, seconds)


class SleepingPool(ClusterPool[Any, Any]):
    """The pool of a cluster, but for what its workers are."""

    actors: tuple[Any, ...]
    seconds: float

    def new_actor(self, machine: Machine, index: int) -> Any:
        """Return a share of a process."""
        return Sleeper(self.actors[index % len(self.actors)], self.seconds)

    def kill(self, actor: Any) -> None:
        """Let the process live: others share it."""


class SleepingBackend(ClusterBackend):
    """A backend whose workers sleep."""

    actors: tuple[Any, ...] = ()
    seconds: float = 0.0

    def pool(self, *args: Any, size: int, **settings: Any) -> Any:
        """Return sleeping workers."""
        pool = SleepingPool(self.ray, self.machines, None, size=size)  # type: ignore[arg-type]
        pool.actors, pool.seconds = self.actors, self.seconds
        return pool


class Middle:
    """Notes times over the middle of a run: starting and ending do not count."""

    def __init__(self, n_records: int) -> None:
        self._marks = {n_records // 10, n_records * 9 // 10}
        self._n, self.stored = 0, 0.0
        self.seen: list[tuple[float, float, float]] = []

    def on_start(self, plan: Any, *, n_finished: int, n_workers: int) -> None:
        """Do nothing."""

    def on_record(self, record: EpisodeRecord) -> None:
        """Count."""
        self._n += 1
        if self._n in self._marks:
            self.seen.append((time.monotonic(), time.process_time(), self.stored))

    def on_load(self, load: Load) -> None:
        """Do nothing."""

    def on_tick(self) -> bool:
        """Do not stop."""
        return False


def measure(ray: Any, n_workers: int, seconds: float, n_records: int) -> dict[str, float]:
    """Run an evaluation with sleeping workers; return what the driver did."""
    machines = Machines(ray, say=lambda _line: None)
    machines.survey()
    for machine in machines:
        machine.n_cores = n_workers
    n_processes = -(-n_workers // WORKERS_PER_PROCESS)
    sleepers = ray.remote(Sleepers).options(num_cpus=0, max_concurrency=WORKERS_PER_PROCESS)
    actors = tuple(sleepers.remote() for _ in range(n_processes))
    ray.get([actor.ready.remote() for actor in actors])
    backend = type("Backend", (SleepingBackend,), {"actors": actors, "seconds": seconds})(ray, machines)
    config = EvalConfig(
        name="throughput",
        tasks=("RememberColor3-v0",),
        policies=("random",),
        episodes=n_records,
        simulator="fake",
        workers=n_workers,
    )
    middle = Middle(n_records)
    folder = Path(tempfile.mkdtemp(prefix="mikasa-vla-throughput-"))
    append_all = RunFolder.append_all

    def timed(self: RunFolder, episodes: Any) -> None:
        begun = time.monotonic()
        append_all(self, episodes)
        middle.stored += time.monotonic() - begun

    RunFolder.append_all = timed  # type: ignore[method-assign]
    try:
        evaluate(resolve(config, out=folder / "run", backend=backend), observer=middle)
    finally:
        RunFolder.append_all = append_all  # type: ignore[method-assign]
        shutil.rmtree(folder)
        for actor in actors:
            ray.kill(actor)
    wall, cpu, stored = (after - before for before, after in zip(*middle.seen, strict=True))
    n_records = n_records * 9 // 10 - n_records // 10
    return {
        "workers": n_workers,
        "records_per_second": n_records / wall,
        "workers_busy": n_records * seconds / (wall * n_workers),
        "driver_cpu_share": cpu / wall,
        "driver_cpu_ms_per_record": 1000 * cpu / n_records,
        "store_share": stored / wall,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    """Print one line per number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[8, 64, 512])
    parser.add_argument("--seconds", type=float, default=0.2, help="of an episode")
    parser.add_argument("--records", type=int, default=20_000, help="at most; a run takes at most 30 s")
    args = parser.parse_args()
    with connected("local") as ray:
        for n_workers in args.workers:
            n_records = min(args.records, int(30 * n_workers / args.seconds))
            found = measure(ray, n_workers, args.seconds, n_records)
            print("  ".join(f"{name} {value:.4g}" for name, value in found.items()), flush=True)


if __name__ == "__main__":
    main()
