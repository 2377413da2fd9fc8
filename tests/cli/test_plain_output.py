"""What a server, a checkpoint, a record, a prompt or a dataset says is printed without control characters."""

import ast
import contextlib
import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

import numpy as np
import pytest
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection

from tests.storage.run_records import describe
from tests.wire.hostile_numbers import packed
from tests.wire.small_servers import SmallServer, serving
from vla_eval.cli.main import main
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.storage.run_folder import RunFolder

ROOT = Path(__file__).parents[2]
FORBIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
ESCAPES = (
    "\x1b[2J\x1b[H",  # clears the screen
    "\x1b]0;owned\x07",  # the terminal's title
    "\x1b]52;c;cm0gLXJm\x07",  # its clipboard
    "\x9b31m",  # colour, by C1
    "\x90q\x9c",
    "\rmikasa-vla: all is well",
    "\b\b\b\x7f",
    "\u202egnp.exe\u202c",  # from right to left
    "\u2067x\u2069",
    "\u2028\u2029\x85",
)
HOSTILE = "evil" + "".join(ESCAPES) + "end"
BIDI = "pick \u202eeht\u202c \u2066cube\u2069"


def said(capsys: pytest.CaptureFixture[str], arguments: list[str], *, code: int | None = 1) -> str:
    """Run the command; return all that it printed, which has no control character."""
    capsys.readouterr()
    found = main(arguments)
    out, err = capsys.readouterr()
    assert code is None or found == code, err
    for text in (out, err):
        assert not FORBIDDEN.search(text), ascii(text)
    return out + err


@contextlib.contextmanager
def hostile_server(**metadata: object) -> Iterator[str]:
    server = SmallServer(**metadata)
    usual = server.usual_answer
    server.answer = lambda one: HOSTILE if one.get("endpoint") == "infer" else usual(one)
    with serving(server, process_request=healthy) as url:
        yield url


def healthy(connection: ServerConnection, request: Request) -> Response | None:
    return connection.respond(HTTPStatus.OK, "OK\n") if request.path == "/healthz" else None


class TestServers:
    def test_its_errors(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with hostile_server() as url:
            arguments = ["--task", "RememberColor3-v0", "--episodes", "1", "--workers", "1"]
            arguments += ["--set", "simulator=fake", "--set", "max_consecutive_errors=1"]
            evaluated = said(
                capsys, ["eval", "--policy", url, *arguments, "--out", str(tmp_path / "run")], code=None
            )
            assert "evil\\u001b[2J" in evaluated
            assert "evil\\u001b[2J" in said(capsys, ["check", url])
            assert "\\u202egnp.exe" in said(capsys, ["report", str(tmp_path / "run")], code=None) + evaluated
        for log in (tmp_path / "run").rglob("*.log"):  # read on terminals, too
            assert not FORBIDDEN.search(log.read_text()), log

    def test_what_it_says_of_itself(self, capsys: pytest.CaptureFixture[str]) -> None:
        for field in ("name", "control_mode", "prompt_key", "protocol", "chunk_size", "state_layouts"):
            with hostile_server(**{field: HOSTILE}) as url:
                said(capsys, ["check", url], code=None)
                said(capsys, ["eval", "--policy", url, "--task", "RememberColor3-v0", "--dry-run"], code=None)

    def test_a_first_message_that_is_none(self, capsys: pytest.CaptureFixture[str]) -> None:
        def speak(connection: object) -> None:
            connection.send(HOSTILE)  # type: ignore[attr-defined]

        def map_of(connection: object) -> None:
            connection.send(packed({HOSTILE: HOSTILE, "actions": np.zeros(2)}))  # type: ignore[attr-defined]

        for handler in (speak, map_of):
            with serving(handler) as url:
                assert "evil" in said(capsys, ["check", url], code=None) or handler is map_of

    def test_the_plug_in_s_check(self) -> None:
        with hostile_server() as url:
            done = subprocess.run(
                [sys.executable, "-m", "mikasa_vla_client", url],
                capture_output=True,
                cwd=ROOT / "plugins/mikasa_vla_client",
                env={**os.environ, "PYTHONPATH": str(ROOT / "plugins/mikasa_vla_client")},
            )
        text = (done.stdout + done.stderr).decode()
        assert done.returncode == 1 and not FORBIDDEN.search(text) and "\\u001b[2J" in text


class TestFiles:
    def test_a_checkpoint(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for config in (
            {"type": HOSTILE},
            {"type": "act", HOSTILE: 1},
            {"type": "act", "device": HOSTILE},
            HOSTILE,
        ):
            (tmp_path / "config.json").write_text(json.dumps(config))
            (tmp_path / "model.safetensors").write_bytes(b"")
            said(capsys, ["checkpoint", "verify", str(tmp_path)])

    def test_a_record(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        error = EpisodeError(kind="WorkerCrashed", stage="step", message=HOSTILE, details=HOSTILE)
        with RunFolder.open(tmp_path / "run", describe(config={}, environment={}, recipes={})) as folder:
            for seed in (1, 2):
                record = EpisodeRecord(
                    task="T", policy="p", n_action_steps=1, run=0, seed=seed, outcome="error", error=error
                )
                folder.append(record)
        for fmt in ("markdown", "csv", "json", "latex", "html-table"):
            said(capsys, ["report", str(tmp_path / "run"), "--format", fmt], code=None)
        file = tmp_path / "run/episodes.jsonl"
        for name in ("task", "policy"):
            lines = [{**json.loads(line), name: HOSTILE} for line in file.read_text().split("\n") if line]
            whole = file.read_text()
            file.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
            assert "evil" in said(capsys, ["report", str(tmp_path / "run")])
            file.write_text(whole)
        (tmp_path / "run/run.json").write_text(json.dumps({HOSTILE: HOSTILE}))
        said(capsys, ["report", str(tmp_path / "run")])

    def test_an_instruction(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        text = (ROOT / "prompts/paper.yaml").read_text()
        (tmp_path / "odd.yaml").write_text(re.sub(r"(?<=^    - ).*$", BIDI, text, flags=re.M))
        printed = said(
            capsys, ["show", "RememberColor3-v0", "--prompt-set", str(tmp_path / "odd.yaml")], code=0
        )
        assert "pick \\u202eeht\\u202c \\u2066cube\\u2069" in printed

    def test_a_dataset(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "meta").mkdir()
        for info in ({"codebase_version": HOSTILE}, {HOSTILE: HOSTILE}, HOSTILE):
            (tmp_path / "meta/info.json").write_text(json.dumps(info))
            for verb in (["dataset", "card"], ["dataset", "check-leak"], ["view", "--print"]):
                said(capsys, [*verb, str(tmp_path)])

    def test_names_of_files_and_arguments(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for name in ESCAPES:
            folder = tmp_path / f"run{name}"
            folder.mkdir()
            said(capsys, ["report", str(folder)])
            said(capsys, ["eval", "--policy", name, "--task", "RememberColor3-v0"])
            said(capsys, ["eval", "--policy", "oracle", "--task", name])
            said(capsys, ["eval", f"--{name}"])
            said(capsys, [f"x{name}"])
            said(capsys, ["eval", "--task", "RememberColor3-v0", "--policy", "oracle", "--set", f"x={name}"])


def test_lines_for_programs_hold_no_control_character(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with hostile_server(name="a") as url:
        arguments = [
            "--task",
            "RememberColor3-v0",
            "--episodes",
            "1",
            "--workers",
            "1",
            "--json-progress",
            "2",
        ]
        main(
            ["eval", "--policy", url, *arguments, "--set", "simulator=fake", "--out", str(tmp_path / "r\x7f")]
        )
    text = capfd.readouterr().err
    assert "{" in text and not FORBIDDEN.search(text)


BARS = """
import sys
from tqdm import tqdm
from vla_eval.cli.terminal.episode_bar import EpisodeBar
from vla_eval.cli.terminal.streams import standard_streams
with standard_streams():
    bar = EpisodeBar()
    bar.begin(n_done=0, n_total=2, title="task\\x1b[2J")
    bar.advance(n_done=1, note="note\\x9b")
    bar.write("error: \\x1b[H\\rfake")
    bar.close()
    for _ in tqdm(range(2), desc="outer", mininterval=0):
        for _ in tqdm(range(2), desc="inner", mininterval=0, leave=False):
            pass
    raise ArithmeticError("\\x1b[2Jtraceback")
"""


def test_on_a_terminal_bars_still_move_and_their_texts_are_plain() -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))  # rows, columns, pixels
    with subprocess.Popen([sys.executable, "-c", BARS], stdout=theirs, stderr=theirs, cwd=ROOT) as process:
        os.close(theirs)
        data = b""
        with contextlib.suppress(OSError):  # the other end is closed
            while part := os.read(ours, 4096):
                data += part
        process.wait(30)
    os.close(ours)
    text = data.decode().replace("\r\n", "\n")
    moves = text.replace("\x1b[A", "")
    assert not FORBIDDEN.search(moves.replace("\r", "")), ascii(text)
    assert re.search(r"\rtask\\u001b\[2J:.*1/2 .*note\\u009b", text)
    assert "\rfake" not in text and "error: \\u001b[H\\rfake\n" in text
    assert "\router: 100%|" in text and "\x1b[A" in text  # a bar below another one
    assert "ArithmeticError: \\u001b[2Jtraceback" in text


def test_nothing_is_printed_past_the_streams() -> None:
    """Every module prints through `sys.stdout` and `sys.stderr`, which the command and workers replace."""
    allowed = {
        "cli/terminal/progress.py": {"os.write"},  # a constant sentence, from a signal's handler
        "cli/terminal/json_progress.py": {"os.write"},
        "storage/durable.py": {"os.write"},
        "workers/framing.py": {"os.write"},
        "workers/process.py": {"os.write"},
        "workers/inside.py": {"sys.__stdout__", "sys.__stderr__"},  # their descriptors
    }
    for path in sorted((ROOT / "vla_eval").rglob("*.py")):
        tree = ast.parse(path.read_text())
        used = {
            f"{node.value.id}.{node.attr}"
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        }
        used |= {
            "stream.buffer"
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and node.attr == "buffer"
            and isinstance(node.value, ast.Attribute)
            and node.value.attr in ("stdout", "stderr")
        }
        past = used & {"os.write", "sys.__stdout__", "sys.__stderr__", "stream.buffer", "os.writev"}
        name = str(path.relative_to(ROOT / "vla_eval"))
        assert past <= allowed.get(name, set()), name
