"""The examples of `docs/another_environment.md`, word for word but for the port, with this Python.

`tests/peers` runs them in environments of their own.
"""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.peers.programs import PLUGIN, example, free_port, running, with_path
from vla_eval.cli.main import main
from vla_eval.storage.run_folder import read_run
from vla_eval.testing.check_remote import check_remote

PAGE = "another_environment.md"


@pytest.mark.parametrize("name", ["numpy_policy.py", "memory_policy.py"])
def test_an_example_passes_the_check(name: str, tmp_path: Path) -> None:
    with served_example(name, tmp_path) as port:
        assert "GET /healthz answers 200." in check_remote(f"ws://127.0.0.1:{port}")


def test_the_example_with_memory_is_evaluated(tmp_path: Path) -> None:
    with served_example("memory_policy.py", tmp_path) as port:
        url, out = f"ws://127.0.0.1:{port}", tmp_path / "run"
        words = ("--task", "RememberColor3-v0", "--policy", url, "--episodes", "2", "--workers", "1")
        assert main(["eval", *words, "--set", "simulator=fake", "--out", str(out)]) == 0
    records = read_run(out).records
    assert [record.outcome == "error" for record in records] == [False, False]
    assert {record.policy for record in records} == {f"cue_average@127.0.0.1-{port}"}
    assert {record.n_action_steps for record in records} == {4}  # as the server says


@contextlib.contextmanager
def served_example(name: str, folder: Path) -> Iterator[int]:
    """Serve an example of the page on a free port."""
    port = free_port()
    (folder / name).write_text(example(PAGE, name).replace("8000", str(port)))
    with running([sys.executable, name], port, cwd=folder, env=with_path(PLUGIN)):
        yield port
