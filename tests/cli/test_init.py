"""`mikasa-vla init` writes a configuration that runs, and whose comments are right."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.init import STARTER
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.protocol import fill_from_protocol
from vla_eval.strict.decoding import decode, load_yaml


def read(text: str) -> dict[str, Any]:
    data = load_yaml(text, where="starter")
    assert isinstance(data, dict)
    return data


def test_it_is_written_once_and_the_next_command_plans_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my runs").mkdir()
    monkeypatch.chdir(tmp_path)

    assert main(["init", "my runs/own.yaml"]) == 0
    out, err = capsys.readouterr()
    written = Path("my runs/own.yaml").read_bytes()
    assert out == "my runs/own.yaml\n"
    assert main(["init", "my runs/own.yaml"]) == 1
    assert "is not overwritten" in capsys.readouterr().err
    assert Path("my runs/own.yaml").read_bytes() == written

    program, *words = shlex.split(err.strip().removeprefix("Next: "))
    assert program == "mikasa-vla"
    assert main([*words, "--set", "simulator=fake"]) == 0
    # 3 policies x 3 numbers of actions x 100 episodes
    assert "episodes: 900 to run" in capsys.readouterr().out


def test_each_line_that_is_commented_out_is_one_that_is_read() -> None:
    text = STARTER.format(name="own")
    plain = decode(EvalConfig, read(text), where="starter")
    keys = re.findall(r"^# (\w+: .*)$", text, re.MULTILINE)
    assert len(keys) >= 5
    for line in keys:
        data = {**read(text), **read(line)}
        fill_from_protocol(data)
        assert decode(EvalConfig, data, where=line) != plain
    for entry in re.findall(r"^  # (- .*)$", text, re.MULTILINE):
        data = {**read(text), "policies": load_yaml(entry, where=entry)}
        assert decode(EvalConfig, data, where=entry).policies != plain.policies
