"""With the doors of checkpoints open, the lock alone lets no payload run."""

import contextlib
import sys
from pathlib import Path

import pytest
import transformers

from tests.checkpoints import hostile_folders
from tests.checkpoints.hostile_folders import PAYLOADS, write_hostile
from tests.checkpoints.test_closed_doors import LOADERS
from vla_eval.lock.switch import distrust, locked

trace = hostile_folders.trace
RUNNING = ("auto_map", "auto_map_of_another_repository")
"""Payloads that do run where there is neither door nor lock."""


@pytest.fixture(autouse=True)
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """transformers' cache of modules, to which it copies code, and which it then puts on `sys.path`."""
    folder = tmp_path / "modules"
    folder.mkdir()
    for module in hostile_folders.COPY_AND_IMPORT:
        monkeypatch.setattr(f"{module}.HF_MODULES_CACHE", str(folder))
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("HF_MODULES_CACHE", str(folder))
    return folder


def load_all(folder: Path) -> None:
    for name in LOADERS:
        for trusted in (None, True):
            with contextlib.suppress(Exception):  # transformers makes what it likes of a refusal
                getattr(transformers, name).from_pretrained(str(folder), trust_remote_code=trusted)


@pytest.mark.parametrize("payload", PAYLOADS)
@pytest.mark.parametrize("is_searched", [False, True])
def test_a_payload_leaves_no_trace(
    tmp_path: Path, trace: Path, modules: Path, payload: str, is_searched: bool
) -> None:
    hostile = write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace)
    if is_searched:  # an earlier load has put the cache on the search path
        sys.path.append(str(modules))
    with locked():
        distrust(hostile)
        load_all(hostile)
    assert not trace.exists()


@pytest.mark.parametrize("payload", RUNNING)
def test_without_the_lock_it_does_run(tmp_path: Path, trace: Path, payload: str) -> None:
    load_all(write_hostile(tmp_path / "all" / "author" / "hostile", payload, trace))
    assert trace.exists()
