"""The completion for shells: what bash offers, and that no file of the working directory can be run by it."""

import shutil
import subprocess
from pathlib import Path

import pytest

from vla_eval.cli.main import VERBS, main

BASH = shutil.which("bash")


def script(capsys: pytest.CaptureFixture[str], shell: str) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def offered(completion: str, *words: str) -> list[str]:
    """Return what bash offers for the last word."""
    typed = " ".join(f"'{word}'" for word in ("mikasa-vla", *words))
    code = f"COMP_WORDS=({typed}); COMP_CWORD={len(words)}; _mikasa_vla; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(
        [BASH or "", "-c", f"{completion}\n{code}"], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


@pytest.mark.skipif(BASH is None, reason="no bash on this machine")
def test_bash_offers_verbs_flags_and_names(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    completion = script(capsys, "bash")
    assert offered(completion, "") == list(VERBS)
    assert offered(completion, "rep") == ["report", "reproduce", "replay"]
    assert offered(completion, "eval", "--capt") == ["--capture-video", "--capture-rrd", "--capture-strip"]
    assert offered(completion, "eval", "--policy", "cue_b") == ["cue_blind"]
    assert offered(completion, "eval", "--policy", "oracle", "cue_b") == ["cue_blind"]
    assert offered(completion, "eval", "--task", "RememberColor9") == ["RememberColor9-v0"]
    assert offered(completion, "show", "ShellGameTo") == ["ShellGameTouch-v0"]


@pytest.mark.skipif(BASH is None, reason="no bash on this machine")
def test_a_name_that_a_shell_would_run_is_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policies").mkdir()
    (tmp_path / "policies" / "$(touch made).yaml").write_text("")
    completion = script(capsys, "bash")
    assert "touch made" not in completion
    offered(completion, "eval", "--policy", "x")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_other_shells_have_every_verb(capsys: pytest.CaptureFixture[str], shell: str) -> None:
    completion = script(capsys, shell)
    assert [verb for verb in VERBS if verb not in completion] == []
    interpreter = shutil.which(shell)
    if interpreter is not None:
        subprocess.run([interpreter, "-n"], input=completion, text=True, check=True)
