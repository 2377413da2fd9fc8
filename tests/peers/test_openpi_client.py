"""openpi's own client, from its wheel with numpy 1, drives `mikasa-vla serve`."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.peers.conftest import versions
from tests.peers.programs import PLUGIN, ROOT, example, free_port, run_python, running, with_path

pytestmark = pytest.mark.peer

PAGE = "another_environment.md"


@pytest.fixture(scope="module")
def openpi(make_environment: Callable[..., Path]) -> Path:
    # Its wheel imports typing_extensions and does not declare it.
    python = make_environment("openpi-client==0.1.2", "typing_extensions")
    found = versions(python, "openpi-client", "numpy", "websockets", "msgpack")
    print(found)
    assert found["numpy"].startswith("1.")
    return python


def run_client(python: Path, port: int, folder: Path) -> str:
    """Run the example of the page with openpi's client."""
    text = example(PAGE, "openpi_client_example.py").replace("8000", str(port))
    (folder / "client.py").write_text(text)
    done = run_python(python, "client.py", cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("max_batch", [1, 8])
def test_openpis_client_gets_chunks_of_a_policy_with_memory(
    openpi: Path, max_batch: int, tmp_path: Path
) -> None:
    port = free_port()
    serve = [sys.executable, "-m", "vla_eval.cli", "serve", "--policy", "memory_color3", "--port", str(port)]
    with running([*serve, "--max-batch", str(max_batch)], port, cwd=tmp_path, env=with_path(ROOT)):
        printed = run_client(openpi, port, tmp_path)
    name, *shapes = printed.splitlines()
    assert name == "memory_color3"
    assert len(shapes) == 3 and len(set(shapes)) == 1 and shapes[0].endswith(", 7)")


def test_openpis_client_gets_chunks_of_the_plugins_server(openpi: Path, tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "memory_policy.py").write_text(example(PAGE, "memory_policy.py").replace("8000", str(port)))
    with running([sys.executable, "memory_policy.py"], port, cwd=tmp_path, env=with_path(PLUGIN)):
        assert run_client(openpi, port, tmp_path) == "cue_average\n" + "(4, 7)\n" * 3


def test_an_error_of_the_policy_is_openpis_error(openpi: Path, tmp_path: Path) -> None:
    port = free_port()
    text = example(PAGE, "memory_policy.py").replace("8000", str(port))
    (tmp_path / "memory_policy.py").write_text(text.replace('"cue_average"', '"other"'))
    script = (
        "from openpi_client.websocket_client_policy import WebsocketClientPolicy\n"
        f"policy = WebsocketClientPolicy(host='127.0.0.1', port={port})\n"
        "try:\n"
        "    policy.infer({'prompt': 'p'})\n"
        "except RuntimeError as error:\n"
        "    print(error)\n"
    )
    with running([sys.executable, "memory_policy.py"], port, cwd=tmp_path, env=with_path(PLUGIN)):
        done = run_python(openpi, "-c", script)
    assert "the observation has no 'observation/image'" in done.stdout
    assert "Traceback" not in done.stdout
