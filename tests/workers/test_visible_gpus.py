"""Which GPUs this process may use."""

import os

import pytest

from vla_eval.workers import start
from vla_eval.workers.start import VISIBLE_GPUS, visible_gpus


@pytest.mark.parametrize(
    ("visible", "expected"),
    [
        (None, ("0", "1")),
        ("", ()),
        ("-1", ()),
        ("3", ("3",)),
        ("1, GPU-12ab", ("1", "GPU-12ab")),
    ],
)
def test_gpus_are_those_that_the_process_may_use(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, expected: tuple[str, ...]
) -> None:
    monkeypatch.setattr(start, "nvidia_driver_version", lambda: "570.1")
    monkeypatch.setattr(os, "listdir", lambda _: ["null", "nvidia0", "nvidia1", "nvidiactl", "nvidia-uvm"])
    monkeypatch.delenv(VISIBLE_GPUS, raising=False)
    if visible is not None:
        monkeypatch.setenv(VISIBLE_GPUS, visible)
    assert visible_gpus() == expected


def test_without_a_driver_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start, "nvidia_driver_version", lambda: None)
    monkeypatch.setenv(VISIBLE_GPUS, "0")
    assert visible_gpus() == ()
