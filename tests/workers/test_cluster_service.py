"""How busy a policy server on a machine of a cluster is. Ray is a stand-in that answers at once."""

from types import SimpleNamespace
from typing import Any

import pytest

from vla_eval.workers.cluster import service as service_module
from vla_eval.workers.cluster.actor import Place
from vla_eval.workers.cluster.machines import Machine
from vla_eval.workers.cluster.service import ClusterService


def remote(call: Any) -> Any:
    return SimpleNamespace(remote=call)


def test_the_share_is_of_the_time_between_two_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    now = SimpleNamespace(seconds=100.0, busy=0.0, n_asked=0)

    def busy_seconds() -> float:
        now.n_asked += 1
        return float(now.busy)

    actor = SimpleNamespace(busy_seconds=remote(busy_seconds), wait=remote(lambda _seconds: 0))
    ray: Any = SimpleNamespace(
        remote=lambda _cls: SimpleNamespace(options=lambda **_: remote(lambda *_args: actor)),
        wait=lambda refs, **_: (refs, []),
        get=lambda ref, **_: ref,
        kill=lambda *_, **__: None,
        exceptions=SimpleNamespace(RayError=ZeroDivisionError),
    )
    monkeypatch.setattr(service_module, "on_machine", lambda node: node)
    monkeypatch.setattr(service_module.time, "monotonic", lambda: now.seconds)
    machine = Machine(node="n", name="n", address="10.0.0.1", n_cores=1, n_gpus=1)
    place = Place(folder=".", variables={}, path=(), logs=".")
    service = ClusterService(
        ray, machine, print, preload=(), place=place, index=0, has_gpu=True, address="10.0.0.1"
    )

    assert service.busy_share() is None and machine.load().gpu_share is None
    now.seconds, now.busy = 110.0, 4.0  # 4 of the first 10 seconds
    assert service.busy_share() == pytest.approx(0.4)
    now.seconds, now.busy = 112.0, 6.0
    assert service.busy_share() == pytest.approx(0.4)  # too early to ask again
    now.seconds, now.busy = 120.0, 11.0  # 7 of the next 10
    assert machine.load().gpu_share == pytest.approx(0.7)
    assert now.n_asked == 2

    service.end()
    assert machine.load().gpu_share is None
