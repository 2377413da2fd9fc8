"""Values that no argument was made for get one message and exit code 1, never a traceback."""

import argparse
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import vla_eval.bench.loader
import vla_eval.bench.official
import vla_eval.bench.rendering
import vla_eval.bench.serving
import vla_eval.doctor
import vla_eval.envs.robot.opening
import vla_eval.serving.server
import vla_eval.training.finetune
import vla_eval.workers.pool
from tests.cli.hostile_arguments import LONG, Case, cases, parsers
from vla_eval.cli.main import build_parser, main
from vla_eval.cli.shared.arguments import seeds_argument
from vla_eval.errors import VlaEvalError

TASK = "RememberColor3-v0"
NEEDED: dict[tuple[str, ...], str] = {
    ("init",): "own.yaml",
    ("eval",): f"--task {TASK} --policy oracle --set simulator=fake",
    ("report",): "nothing",
    ("merge",): "nothing --out new",
    ("compare",): "nothing",
    ("reproduce",): f"100/100 --task {TASK} --policy oracle --set simulator=fake",
    ("passport",): "nothing",
    ("check",): "oracle",
    ("audit",): f"--task {TASK} --set simulator=fake",
    ("probe",): f"--task {TASK} --policy oracle --set simulator=fake",
    ("real",): "--robot simulated_so100 --policy random",
    ("view",): "recorded",
    ("record",): f"--task {TASK} --set simulator=fake",
    ("replay",): "recorded",
    ("dataset", "convert"): "recorded --to npz --out new",
    ("dataset", "mix"): "recorded --out new",
    ("dataset", "check"): "recorded",
    ("dataset", "adopt"): "recorded",
    ("dataset", "check-leak"): "recorded",
    ("dataset", "card"): "recorded",
    ("dataset", "push"): "recorded nobody/nothing",
    ("dataset", "pull"): "nobody/nothing new",
    ("finetune",): "--policy act --dataset recorded --allow-unreplayed",
    ("train-agent",): f"--algorithm ppo --task {TASK}",
    ("checkpoint", "verify"): "nothing",
    ("checkpoint", "fetch"): "smolvla_base --out new",
    ("checkpoint", "rehearse"): "nothing",
    ("checkpoint", "merge"): "nothing --out new",
    ("checkpoint", "convert-octo"): "nothing --out new",
    ("checkpoint", "convert-openvla"): "nothing --out new",
    ("checkpoint", "convert-spatialvla"): "nothing --out new",
    ("serve",): "--policy random --task RememberColor3-v0",
    ("list",): "",
    ("show",): TASK,
    ("doctor",): "",
    ("bench",): "--loader",
    ("completion",): "bash",
}
LONGEST_MESSAGE = 3_000  # characters


@pytest.fixture
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command whose values are accepted ends where its work would begin."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise VlaEvalError("in a test, nothing runs")

    monkeypatch.setattr(vla_eval.workers.pool.WorkerPool, "__init__", refuse)
    for module, name in (
        (vla_eval.envs.robot.opening, "open_robot"),
        (vla_eval.serving.server, "run_server"),
        (vla_eval.training.finetune, "finetune"),
        (vla_eval.bench.loader, "run_loader_bench"),
        (vla_eval.bench.rendering, "run_bench"),
        (vla_eval.bench.official, "run_official_bench"),
        (vla_eval.bench.serving, "run_serving_bench"),
        (vla_eval.doctor, "run_probe"),
    ):
        monkeypatch.setattr(module, name, refuse)
    if find_spec("stable_baselines3") is not None:
        monkeypatch.setattr("vla_eval.agents.train.train_agent", refuse)


def outcome(case: Case, capsys: pytest.CaptureFixture[str]) -> str | None:
    """Return what is wrong with how a command line is answered."""
    try:
        code = main(case.argv)
    except SystemExit as exc:  # argparse's
        code = int(exc.code or 0)
    except Exception as exc:
        return f"{type(exc).__name__}: {exc!s:.100}"
    message = capsys.readouterr().err
    if code not in (0, 1):
        return f"exit code {code}"
    if code == 1 and "error: " not in message:
        return "no message"
    if len(message) > LONGEST_MESSAGE:
        return f"a message of {len(message)} characters"
    if "\0" in case.hostile and (code, "expected text in UTF-8" in message) != (1, True):
        return f"accepted: {message:.100}"
    return None


@pytest.mark.sampled(6)
@pytest.mark.parametrize("verb", [verb for verb, _ in parsers(build_parser())], ids=" ".join)
def test_a_value_that_no_argument_was_made_for_gets_one_message(
    verb: tuple[str, ...],
    nothing_runs: None,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "here").mkdir()
    shutil.move(recorded, tmp_path / "here" / "recorded")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    wrong = {
        str([argument[:40] for argument in case.argv]): said
        for case in cases(verb, NEEDED[verb].split())
        if (said := outcome(case, capsys)) is not None
    }
    assert wrong == {}


@pytest.mark.parametrize("text", ["1-99999999999999999999", "1-1000001", "0-4294967295", "4294967296"])
def test_more_seeds_than_can_be_held_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="found '"):
        seeds_argument(text)


@pytest.mark.parametrize(("text", "seeds"), [("7", range(7, 8)), ("1-1000000", range(1, 1000001))])
def test_seeds_up_to_the_largest_number_are_read(text: str, seeds: range) -> None:
    assert seeds_argument(text) == seeds


HOSTS = [LONG, "a..b", f"a.{'b' * 64}.c", "ü" * 100, ".", "1.2.3.4.5", "[", "[::1", "a b"]


@pytest.mark.parametrize("host", HOSTS, ids=ascii)
def test_a_host_that_no_name_server_takes_gets_one_message(
    host: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names are encoded before they are looked up: parts of more than 63 characters, or none, are errors."""
    url = f"ws://{host}:80"
    for argv in (
        ["check", url],
        ["eval", "--task", TASK, "--set", "simulator=fake", "--policy", url],
        ["serve", "--policy", "random", "--task", TASK, "--port", "0", "--host", host],
    ):
        assert main(argv) == 1
        message = capsys.readouterr().err
        assert "error: " in message and len(message) < LONGEST_MESSAGE


def test_an_error_of_the_system_that_is_about_no_path_keeps_its_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import vla_eval.cli.show as show

    def broken(_: argparse.Namespace) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(show, "run", broken)
    with pytest.raises(OSError, match="Input/output error"):
        main(["show", TASK])


def test_a_long_value_is_repeated_in_part(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["view", "run", "--seed", LONG])
    message = capsys.readouterr().err
    assert "x" * 100 in message and "x" * 201 not in message
