"""The queue of a cluster: every job gets one answer, whoever dies. Ray is a stand-in that calls at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.workers.cluster import pool as pool_module
from vla_eval.workers.cluster.actor import Place
from vla_eval.workers.cluster.machines import Machine
from vla_eval.workers.cluster.pool import MAX_JOBS_PER_CALL, MAX_LOSSES, ClusterPool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered, JobList
from vla_eval.workers.messages import Failed
from vla_eval.workers.process import WorkerSpec


@dataclass(frozen=True)
class Job:
    number: int
    setup_key: str = "a"
    n_items: int = 1


class Lost(Exception):
    pass


class StandIn:
    """Its actors do what `do` does with the jobs of a call."""

    exceptions = SimpleNamespace(
        RayError=Lost,
        **dict.fromkeys(("RayActorError", "WorkerCrashedError", "NodeDiedError"), Lost),
        **dict.fromkeys(("OutOfMemoryError", "ActorUnschedulableError", "ObjectLostError"), Lost),
    )

    def __init__(self, do: Callable[[Sequence[Job]], list[Any]]) -> None:
        self.n_actors, self.calls, self._do = 0, list[list[Job]](), do

    def remote(self, _cls: type) -> Any:
        def start(*_: Any) -> Any:
            self.n_actors += 1
            methods = {"ready": lambda: None, "do": self._note, "close": lambda: None}
            return SimpleNamespace(**{name: method(call) for name, call in methods.items()})

        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=start))

    def _note(self, jobs: list[Job]) -> list[Any]:
        self.calls.append(jobs)
        return self._do(jobs)

    def wait(self, refs: list[Any], **_: Any) -> tuple[list[Any], list[Any]]:
        return refs, []

    def get(self, refs: Any) -> Any:
        return [ref() for ref in refs] if isinstance(refs, list) else refs()

    def kill(self, actor: Any, *, no_restart: bool) -> None:
        assert no_restart


def method(call: Callable[..., Any]) -> Any:
    """Return what Ray makes of a method; a call happens once, when its result is fetched."""

    def remote(*args: Any) -> Callable[[], Any]:
        results: list[Any] = []

        def fetch() -> Any:
            if not results:
                try:
                    results.append(call(*args))
                except Lost as exc:
                    results.append(exc)
            if isinstance(results[0], Lost):
                raise results[0]
            return results[0]

        return fetch

    return SimpleNamespace(remote=remote)


class OneMachine:
    def __init__(self) -> None:
        self.machine = Machine(node="n", name="n", address="127.0.0.1", n_cores=2, n_gpus=0)
        self.machine.facts = SimpleNamespace()  # type: ignore[assignment]  # it has answered

    def __iter__(self) -> Any:
        return iter([self.machine])

    def look(self, *, at_once: bool = False) -> None:
        pass

    def say(self, line: str) -> None:
        pass

    note_error = note_answer = lambda *_, **__: None


def run(ray: StandIn, jobs: Sequence[Job], monkeypatch: pytest.MonkeyPatch) -> list[Answered[Job, Any]]:
    monkeypatch.setattr(pool_module, "on_machine", lambda node: node)
    place = Place(folder=".", variables={}, path=(), logs=str(Path.cwd()))
    spec = WorkerSpec(
        runner=RunnerClass(target="builtins:print"), answers=(), timeouts=TimeoutConfig(), logs=Path.cwd()
    )
    pool: ClusterPool[Job, Any] = ClusterPool(ray, OneMachine(), spec, place, size=2, takes_gpu=False)  # type: ignore[arg-type]
    with pool as running:
        return [event for event in running.run(JobList(jobs)) if isinstance(event, Answered)]


def test_a_job_that_kills_its_workers_is_an_error_and_the_others_are_answered_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def do(jobs: Sequence[Job]) -> list[Any]:
        if any(job.number == 3 for job in jobs):
            raise Lost("out of memory")
        return [job.number for job in jobs]

    ray = StandIn(do)
    answered = run(ray, [Job(number) for number in range(8)], monkeypatch)

    failed = [one for one in answered if isinstance(one.answer, Failed)]
    assert [one.job.number for one in failed] == [3]
    assert "out of memory" in failed[0].answer.error.message
    assert sorted(one.job.number for one in answered) == list(range(8))
    assert sum(any(job.number == 3 for job in call) for call in ray.calls) == MAX_LOSSES


def test_short_jobs_of_one_setup_share_a_call_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = StandIn(lambda jobs: [job.number for job in jobs])
    jobs = [Job(number, "a" if number < 70 else "b") for number in range(100)]
    answered = run(ray, jobs, monkeypatch)

    assert sorted(one.answer for one in answered) == list(range(100))
    assert all(one.job.number == one.answer for one in answered)
    assert max(len(call) for call in ray.calls) == MAX_JOBS_PER_CALL
    assert all(len({job.setup_key for job in call}) == 1 for call in ray.calls)
