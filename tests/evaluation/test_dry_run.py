"""A dry run of an evaluation counts what is left, and changes nothing."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.evaluation_bench import Bench
from tests.evaluation.evaluation_bench import bench as bench
from tests.evaluation.resolved import evaluate, evaluation_effort
from tests.wire.small_servers import SmallServer, serving
from vla_eval.cli.main import main
from vla_eval.config.evaluation import CaptureConfig, EvalConfig
from vla_eval.errors import VlaEvalError
from vla_eval.evaluation import evaluate as evaluating
from vla_eval.evaluation.dry_run import AssumedRates
from vla_eval.memory_change import MemoryChange
from vla_eval.policies import entries


def config() -> EvalConfig:
    return EvalConfig(
        name="dry",
        tasks=("RememberColor3-v0",),
        policies=("oracle", "random"),
        n_action_steps=(1, 7),
        episodes=2,
        simulator="fake",
        workers=1,
    )


def test_steps_inferences_and_frames_are_those_of_episodes_without_a_result(tmp_path: Path) -> None:
    out = tmp_path / "run"
    effort = evaluation_effort(config(), out=out)
    assert not out.exists()
    assert (effort.n_episodes, effort.n_finished) == (8, 0)  # 2 policies, 2 numbers of steps, 2 seeds
    assert effort.n_steps == 8 * 60
    assert effort.n_inferences == 4 * 60 + 4 * 9  # 60 steps by sevens are nine inferences
    assert effort.n_frames == effort.n_learned_inferences == 0  # scripted policies read no image
    evaluate(config(), out=out)
    after = evaluation_effort(config(), out=out)
    assert (after.n_episodes, after.n_finished, after.n_steps) == (8, 8, 0)


def test_a_policy_that_is_shown_every_frame_has_a_frame_of_each_step() -> None:
    learned = dataclasses.replace(config(), policies=("memory_color3", "oracle"), n_action_steps=(6,))
    effort = evaluation_effort(learned, out=Path("nowhere"))
    assert effort.n_inferences == 4 * 10 and effort.n_learned_inferences == 2 * 10
    assert effort.n_frames == 2 * 2 * 60  # cameras, episodes, steps; the oracle reads no image


@pytest.mark.parametrize(
    ("change", "donor_steps"),
    [
        ({"kind": "carry_over"}, 60),  # the whole episode of the seed before
        ({"kind": "transplant", "at_step": 10, "donor_env": {"swap_cue": 1}}, 12),  # to the third inference
        ({"kind": "transplant", "at_step": 12, "donor_env": {"swap_cue": 1}}, 12),
        ({"kind": "hold_memory", "at_step": 10}, 0),
    ],
)
def test_the_episodes_that_give_their_memory_are_counted(change: dict[str, Any], donor_steps: int) -> None:
    changed = dataclasses.replace(
        config(),
        policies=("memory_color3",),
        n_action_steps=(6,),
        memory_change=MemoryChange(**change),
    )
    effort = evaluation_effort(changed, out=Path("nowhere"))
    assert effort.n_steps == 2 * (60 + donor_steps)
    assert effort.n_inferences == 2 * (60 + donor_steps) / 6
    assert effort.n_frames == 2 * 2 * (60 + donor_steps)


@pytest.mark.parametrize(
    ("said", "fields", "expected"),
    [
        ({}, {}, 10),  # 60 steps by sixes
        ({"needs_every_frame": True}, {}, 60),
        ({}, {"eager_rendering": True}, 60),
        ({}, {"cue_view": "first_frame"}, 11),
        ({"cameras": {}}, {}, 0),
    ],
)
def test_frames_of_a_policy_behind_a_socket_are_those_that_its_server_wants(
    said: dict[str, Any], fields: dict[str, Any], expected: int
) -> None:
    camera = {"base_camera": {"key": "image", "height_px": 128, "width_px": 128}}
    with serving(SmallServer(**{"cameras": camera, "chunk_size": 6, **said})) as url:
        served = dataclasses.replace(config(), policies=(url,), n_action_steps=(6,), episodes=1, **fields)
        assert evaluation_effort(served, out=Path("nowhere")).n_frames == 2 * expected


def test_captured_episodes_have_a_frame_of_every_stride() -> None:
    capture = CaptureConfig(video=1, frame_stride=4)  # of the first seed of each row
    captured = dataclasses.replace(config(), policies=("oracle",), n_action_steps=(1,), capture=capture)
    effort = evaluation_effort(captured, out=Path("nowhere"))
    assert effort.n_frames == 2 * 16  # cameras; steps 0, 4, …, 60


def test_a_policy_of_another_package_may_read_every_step(bench: Bench) -> None:
    other = bench.config(n_action_steps=[4], episodes=1)  # episodes of 12 steps
    assert evaluation_effort(other, out=Path("nowhere")).n_frames == 2 * 12


def test_hours_are_those_of_the_stated_rates() -> None:
    effort = evaluation_effort(config(), out=Path("nowhere"))
    assert effort.seconds(AssumedRates(steps_per_second=10, inference_seconds=1)) == pytest.approx(48)
    learned = dataclasses.replace(config(), policies=("memory_color3",), n_action_steps=(6,))
    rates = AssumedRates(steps_per_second=10, frames_per_second=4, inference_seconds=1)
    # Two episodes: 120 steps, 240 images, 20 inferences.
    assert evaluation_effort(learned, out=Path("nowhere")).seconds(rates) == pytest.approx(12 + 60 + 20)


def test_the_command_prints_what_would_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "--task",
        "RememberColor3-v0",
        "--policy",
        "oracle",
        "--episodes",
        "5",
        "--n-action-steps",
        "4",
    ]
    assert main(["eval", *arguments, "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert "5 to run, 0 of 5 have a result" in printed
    assert "300 control steps, 75 inferences, 0 frames" in printed and "assumptions:" in printed
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def _whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    evaluate(config(), out=out)
    return out


@pytest.fixture
def whole(_whole: Path, tmp_path: Path) -> Path:
    """Return a copy of the folder of a finished run."""
    return Path(shutil.copytree(_whole, tmp_path / "run"))


def test_a_run_that_was_killed_before_its_first_episode_has_all_of_them_to_run(whole: Path) -> None:
    (whole / "episodes.jsonl").unlink()
    effort = evaluation_effort(config(), out=whole)
    assert (effort.n_episodes, effort.n_finished) == (8, 0)


class TestRefusals:
    """Whatever `evaluate` refuses before its first episode, the dry run refuses in the same words."""

    CHANGES: tuple[dict[str, Any], ...] = (
        {"seed_start": 7},
        {"episodes": 1},
        {"env": {"horizon_steps": 29}},
        {"cue_view": "first_frame"},
        {"runs": 1, "n_action_steps": (1,)},
    )

    @pytest.mark.parametrize("changes", CHANGES, ids=lambda changes: next(iter(changes)))
    def test_a_folder_of_another_configuration(self, whole: Path, changes: dict[str, Any]) -> None:
        other = dataclasses.replace(config(), **changes)
        assert _refused(other, whole) == _refused(other, whole, dry=False)

    @pytest.mark.parametrize("content", ["file", "other files", "episodes alone"])
    def test_a_folder_that_no_run_can_go_into(self, tmp_path: Path, content: str) -> None:
        out = tmp_path / "run"
        if content == "file":
            out.write_text("")
        else:
            out.mkdir()
            (out / ("notes.txt" if content == "other files" else "episodes.jsonl")).write_text("")
        assert _refused(config(), out) == _refused(config(), out, dry=False)

    @pytest.mark.parametrize("is_damaged", [True, False])
    def test_a_folder_that_is_damaged_or_has_a_line_too_many(self, whole: Path, is_damaged: bool) -> None:
        if is_damaged:
            (whole / "run.json").write_text("{")
        else:
            lines = (whole / "episodes.jsonl").read_text()
            (whole / "episodes.jsonl").write_text(lines + lines.splitlines()[0] + "\n")
        assert _refused(config(), whole) == _refused(config(), whole, dry=False)

    def test_another_environment_unless_it_is_allowed(
        self, whole: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(evaluating, "collect_environment", lambda: {"python": "another"})
        assert _refused(config(), whole) == _refused(config(), whole, dry=False)
        effort = evaluation_effort(config(), out=whole, allow_environment_change=True)
        assert effort.n_finished == 8


def _refused(asked: EvalConfig, out: Path, *, dry: bool = True) -> str:
    """Return the message of the error."""
    with pytest.raises(VlaEvalError) as refused:
        if dry:
            evaluation_effort(asked, out=out)
        else:
            evaluate(asked, out=out)
    return str(refused.value)


def test_each_policy_is_read_once_and_a_server_asked_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read: list[str] = []
    load = entries.load_policy_recipe

    def counted(name: str) -> Any:
        read.append(name)
        return load(name)

    monkeypatch.setattr(entries, "load_policy_recipe", counted)
    arguments = ["--task", "RememberColor3-v0", "--policy", "memory_color3", "random", "--episodes", "1"]
    arguments += ["--set", "simulator=fake", "--set", "env.horizon_steps=12", "--out", str(tmp_path / "out")]
    for more in (["--dry-run"], ["--workers", "1"]):
        read.clear()
        assert main(["eval", *arguments, *more]) == 0
        assert read == ["memory_color3", "random"]
