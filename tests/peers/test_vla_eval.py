"""allenai's vla-evaluation-harness 0.8.0 from its wheel: its server is evaluated, its client is tried."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.mikasa_vla_client.serving import Sums, served
from tests.peers.conftest import versions
from tests.peers.programs import free_port, mikasa_vla, run_python, running
from vla_eval.storage.run_folder import read_run

pytestmark = pytest.mark.peer

EPISODES = 3
HORIZON_STEPS = 20

# Its baseline without weights; only the size of an action is another one than its robot's.
SERVER = ("-m", "vla_eval.model_servers.behavior1k_baseline", "--args.action_dim=7", "--host=127.0.0.1")

CLIENT = """
import sys
import anyio
import numpy as np
from vla_eval.connection import Connection


async def main():
    connection = Connection(sys.argv[1], timeout=10, max_retries=1)
    await connection.connect(benchmark="mikasa")
    await connection.start_episode({"task": {"name": "pick up the red cube"}})
    images = {"base_camera": np.zeros((128, 128, 3), dtype=np.uint8)}
    action = await connection.act({"images": images, "task_description": "pick up the red cube"})
    print(np.asarray(action["actions"]).shape)


anyio.run(main)
"""


@pytest.fixture(scope="module")
def harness(make_environment: Callable[..., Path]) -> Path:
    """Its environment; its package imports as `vla_eval`, so it can never be installed beside ours."""
    python = make_environment("vla-eval==0.8.0", python=sys.executable)
    print(versions(python, "vla-eval", "numpy", "websockets", "msgpack"))
    return python


def test_its_baseline_server_is_evaluated(harness: Path, tmp_path: Path) -> None:
    port = free_port()
    with running([harness, *SERVER, f"--port={port}"], port, cwd=tmp_path, health="/health"):
        printed = mikasa_vla(
            *("eval", "--task", "RememberColor3-v0", "--policy", f"remote_vla_eval@ws://127.0.0.1:{port}"),
            *("--episodes", str(EPISODES), "--workers", "1", "--set", "simulator=fake"),
            *("--set", f"env.horizon_steps={HORIZON_STEPS}", "--out", tmp_path / "run"),
        )
    records = read_run(tmp_path / "run").records
    assert [record.outcome for record in records] == ["failure"] * EPISODES  # it never moves
    assert [record.n_inferences for record in records] == [HORIZON_STEPS] * EPISODES  # one action per frame
    assert "weights unknown" in printed


def test_its_client_needs_its_own_greeting_which_no_server_of_openpis_protocol_gives(
    harness: Path, tmp_path: Path
) -> None:
    (tmp_path / "client.py").write_text(CLIENT)
    port = free_port()
    with running([harness, *SERVER, f"--port={port}"], port, cwd=tmp_path, health="/health"):
        done = run_python(harness, "client.py", f"ws://127.0.0.1:{port}", cwd=tmp_path)
        assert done.stdout == "(7,)\n", done.stderr  # its client works with its own server
    with served(Sums()) as url:
        done = run_python(harness, "client.py", url, cwd=tmp_path)
    assert done.returncode != 0
    assert "Message missing required fields" in done.stderr
