"""SIGTERM ends a loaded server within 10 s, whatever its policy and its clients do."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from vla_eval.wire.codec import packb, unpackb

ROOT = Path(__file__).parents[2]
LIMIT_SECONDS = 10.0
GOING_AWAY = 1001
POLICY = """
import threading, time
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

class Policy:
    def __init__(self, name, mode):
        self.spec = PolicySpec(name=name, reads="last", cameras=(), states=(), chunk_size=1)
        self.mode = mode
        if mode == "threads":
            threading.Thread(target=time.sleep, args=(3600,)).start()

    def reset(self, episodes):
        if self.mode == "hangs in reset":
            time.sleep(3600)

    def act(self, window):
        print("asked", flush=True)
        while self.mode == "hangs":
            time.sleep(3600)
        while self.mode == "computes in Python":
            pass
        while self.mode == "swallows what is raised":
            try:
                time.sleep(3600)
            except BaseException:
                pass
        time.sleep(2.0 if self.mode == "slow" else 0.05)
        return ActionChunk(actions=np.zeros((1, 7), np.float32))

def make(context, *, mode):
    return Policy(context.name, mode)
"""


@contextmanager
def serving(mode: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `mikasa-vla serve` with such a policy; yield the process and its address."""
    (folder / "sluggish.py").write_text(POLICY)
    recipe = {"version": 1, "description": "d", "adapter": "sluggish:make", "args": {"mode": mode}}
    (folder / "sluggish.yaml").write_text(json.dumps(recipe))
    command = [sys.executable, "-m", "vla_eval.cli", "serve", "--policy", "sluggish.yaml", "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{ROOT}"}
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=folder, env=environment
        ) as process,
    ):
        try:
            assert process.stdout is not None
            found = re.search(r"ws://\S+", process.stdout.readline())
            assert found, (folder / "log").read_text()
            yield process, found[0]
        finally:
            process.kill()


def ends_in(process: subprocess.Popen[str]) -> float:
    """Send SIGTERM; return how long the process took to end."""
    begun = time.monotonic()
    process.send_signal(signal.SIGTERM)
    process.wait(60)
    return time.monotonic() - begun


def close_code(client: ClientConnection) -> int | None:
    with suppress(ConnectionClosed):
        while True:
            client.recv(timeout=15)
    return client.close_code


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("mode", "code"),
    [
        ("hangs", 1),
        ("hangs in reset", 1),
        ("computes in Python", 1),
        ("swallows what is raised", 1),
        ("slow", 0),
        ("fast", 0),
    ],
)
def test_a_server_with_inferences_in_flight_ends_and_says_so(mode: str, code: int, tmp_path: Path) -> None:
    with serving(mode, tmp_path) as (process, url), ExitStack() as opened:
        clients = [opened.enter_context(connect(url)) for _ in range(20)]
        for client in clients:
            client.send(packb({"prompt": "look"}))
            client.send(packb({"endpoint": "infer", "prompt": "look", "session_id": "another"}))
        time.sleep(0.5)
        assert ends_in(process) < LIMIT_SECONDS
        assert process.returncode == code, (tmp_path / "log").read_text()
        assert {close_code(client) for client in clients} == {GOING_AWAY}
    assert ("has not answered for 4 s" in (tmp_path / "log").read_text()) == bool(code)


def test_the_pass_of_a_slow_policy_is_answered_before_the_end(tmp_path: Path) -> None:
    with serving("slow", tmp_path) as (process, url), connect(url) as client:
        client.recv()
        client.send(packb({"prompt": "look"}))
        assert process.stdout is not None and process.stdout.readline() == "asked\n"
        process.send_signal(signal.SIGTERM)
        answer = client.recv(timeout=10)
        assert isinstance(answer, bytes) and unpackb(answer)["actions"].shape == (1, 7)
        assert process.wait(LIMIT_SECONDS) == 0


def test_a_policy_with_a_thread_that_never_ends_does_not_keep_the_server(tmp_path: Path) -> None:
    with serving("threads", tmp_path) as (process, _):
        assert ends_in(process) < LIMIT_SECONDS


@pytest.mark.slow
def test_clients_that_read_nothing_or_never_stop_sending_do_not_keep_the_server(tmp_path: Path) -> None:
    with serving("fast", tmp_path) as (process, url), ExitStack() as opened:
        parts = urlsplit(url)
        for _ in range(20):  # connected, and silent before the handshake
            opened.enter_context(socket.create_connection((parts.hostname, parts.port)))
        for _ in range(5):  # sends, and reads nothing
            deaf = opened.enter_context(connect(url, max_queue=1))
            for n in range(200):
                deaf.send(packb({"endpoint": "reset", "prompt": "look", "session_id": str(n)}))
        large = packb({"endpoint": "observe", "prompt": "look", "x": np.zeros(2**20, np.uint8)})
        stop = threading.Event()

        def flood(client: ClientConnection) -> None:
            with suppress(ConnectionClosed, OSError):
                client.send(packb({"endpoint": "reset", "prompt": "look"}))
                while not stop.is_set():
                    client.send(large)

        floods = [
            threading.Thread(target=flood, args=(opened.enter_context(connect(url)),)) for _ in range(3)
        ]
        for thread in floods:
            thread.start()
        try:
            time.sleep(0.5)
            assert ends_in(process) < LIMIT_SECONDS
        finally:
            stop.set()
            process.kill()
            for thread in floods:
                thread.join()
