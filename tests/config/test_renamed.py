"""Old names in YAML files and on the command line: they mean the new ones, and one warning says so."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from vla_eval.cli.main import build_parser
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.errors import RecipeError
from vla_eval.strict.decoding import decode, warn_renamed
from vla_eval.strict.renamed import formerly

BASE = {"name": "x", "tasks": ["RememberColor3-v0"], "policies": ["oracle"]}


@pytest.fixture(autouse=True)
def nothing_warned_yet() -> Iterator[None]:
    """Forget the warnings of other tests: each name is warned of once per process."""
    warn_renamed.cache_clear()
    yield
    warn_renamed.cache_clear()


def test_the_old_name_of_a_section_means_the_new_one(caplog: pytest.LogCaptureFixture) -> None:
    old, new = (decode(EvalConfig, BASE | {key: {"video": 3}}, where="x") for key in ("recording", "capture"))
    assert old == new and new.capture.video == 3
    assert [record.getMessage() for record in caplog.records] == [
        "warning: 'recording' is now called 'capture'. The old name still works; please use the new one."
    ]


def test_the_old_name_of_held_out_evaluations_means_the_new_one(caplog: pytest.LogCaptureFixture) -> None:
    base = {"policy": "act", "dataset": "d"}
    old, new = (
        decode(FinetuneConfig, base | {key: {"every_steps": 5}}, where="x")
        for key in ("evaluation", "held_out")
    )
    assert old == new and new.held_out is not None
    assert "'evaluation' is now called 'held_out'" in caplog.text


def test_a_name_is_warned_of_once(caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        decode(EvalConfig, BASE | {"recording": {"video": 3}}, where="x")
    assert len(caplog.records) == 1


def test_a_field_under_both_names_is_refused() -> None:
    with pytest.raises(RecipeError, match="'recording' is the old name of 'capture', and both are there"):
        decode(EvalConfig, BASE | {"recording": {}, "capture": {}}, where="x")


@pytest.mark.parametrize("in_file", ["recording", "capture"])
@pytest.mark.parametrize("in_override", ["recording", "capture"])
def test_an_override_changes_the_field_by_either_name(in_file: str, in_override: str) -> None:
    data: dict[str, Any] = BASE | {in_file: {"rrd": 2}}
    apply_overrides(data, [f"{in_override}.video=all"], cls=EvalConfig)
    config = decode(EvalConfig, data, where="x")
    assert (config.capture.rrd, config.capture.video) == (2, "all")


@dataclass(frozen=True)
class Inner:
    size: int = field(default=1, metadata=formerly("length"))


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)


def test_the_warning_names_the_place_of_an_inner_field(caplog: pytest.LogCaptureFixture) -> None:
    assert decode(Outer, {"inner": {"length": 5}}, where="x").inner.size == 5
    assert "'inner.length' is now called 'inner.size'" in caplog.text


def test_an_old_flag_is_stored_as_the_new_one_and_no_help_shows_it(caplog: pytest.LogCaptureFixture) -> None:
    parser = build_parser(["eval"])
    args = parser.parse_args(["eval", "--record-video", "failures", "--record-rrd", "2"])
    assert (args.capture_video, args.capture_rrd) == ("failures", "2")
    assert "--record-video is now called --capture-video" in caplog.text
    assert "--record-rrd is now called --capture-rrd" in caplog.text


def test_an_old_flag_takes_what_the_new_one_takes(capsys: pytest.CaptureFixture[str]) -> None:
    parser = build_parser(["finetune"])
    assert parser.parse_args(["finetune", "--eval-every", "5"]).held_out_every == 5
    assert parser.parse_args(["finetune", "--eval-episodes", "7"]).held_out_episodes == 7
    with pytest.raises(SystemExit):
        parser.parse_args(["finetune", "--eval-every", "often"])
    assert "argument --eval-every: invalid int value: 'often'" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["convert-openvla", "convert-spatialvla"])
def test_pictures_of_a_conversion_are_images(verb: str) -> None:
    parser = build_parser(["checkpoint"])
    args = parser.parse_args(["checkpoint", verb, "base", "--out", "out", "--pictures", "a", "b"])
    assert args.images == ["a", "b"]


def test_the_warning_reaches_standard_error_and_the_help_has_only_the_new_flag() -> None:
    command = [sys.executable, "-m", "vla_eval.cli", "eval", "--record-video", "failure", "--task", "a"]
    shown = subprocess.run([*command, "--policy", "b"], capture_output=True, text=True, check=False)
    warning, error = shown.stderr.splitlines()
    assert warning.startswith("warning: --record-video is now called --capture-video.")
    assert "Did you mean 'failures'?" in error and shown.returncode == 1
    helped = subprocess.run([*command[:4], "--help"], capture_output=True, text=True, check=True).stdout
    assert "--capture-video" in helped and "--record-video" not in helped
