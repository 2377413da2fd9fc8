"""The command line: fast, lazy, and every mistake one message on stderr with exit code 1."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from vla_eval.cli.main import VERBS, build_parser, main
from vla_eval.config.files import list_recipes
from vla_eval.tasks.catalog import TASKS, task_spec
from vla_eval.tasks.source import task_arguments

HEAVY = ("torch", "sapien", "mani_skill", "gymnasium", "lerobot", "cv2", "rerun", "transformers")


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    try:
        code = main(arguments)
    except SystemExit as exc:  # argparse: --help, and mistakes that it finds
        code = int(exc.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def mistake(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the message of what must be a user's mistake."""
    code, out, err = run(capsys, *arguments)
    assert code == 1
    assert out == ""
    assert "Traceback" not in err
    assert err.startswith("mikasa-vla")
    return err


class TestMistakes:
    def test_an_unknown_verb_gets_a_suggestion(self, capsys: pytest.CaptureFixture[str]) -> None:
        message = mistake(capsys, "evla")

        assert message == (
            "mikasa-vla: error: there is no verb 'evla'. Did you mean 'eval'? See `mikasa-vla --help`.\n"
        )

    def test_a_verb_like_none_is_answered_by_all(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert f"Known: {', '.join(VERBS)}." in mistake(capsys, "xyzzy")

    def test_an_unknown_flag(self, capsys: pytest.CaptureFixture[str]) -> None:
        message = mistake(capsys, "eval", "demo", "--polcy", "oracle")

        assert message == (
            "mikasa-vla: error: eval: there is no flag '--polcy'. Did you mean '--policy'? See `mikasa-vla "
            "eval --help`.\n"
        )

    def test_an_unknown_flag_of_a_verb_of_a_verb(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "See `mikasa-vla list --help`" in mistake(capsys, "list", "--kind=tasks")

    def test_one_argument_too_many(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "list: expected no more arguments, found tasks" in mistake(capsys, "list", "tasks", "tasks")

    def test_a_path_that_is_not_there(self, capsys: pytest.CaptureFixture[str]) -> None:
        message = mistake(capsys, "eval", "--task", "RememberColor3-v0", "--policy", "runs/nothing/here")

        assert message.startswith(
            "mikasa-vla: error: runs/nothing/here: there is no such file or folder in /"
        )
        assert "mikasa-vla list policies" in message and "oracle" not in message

    def test_a_long_list_of_names_is_given_only_if_none_is_close(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        eval_with = ("eval", "--task", "RememberColor3-v0", "--policy")
        close, far = (mistake(capsys, *eval_with, name) for name in ("oracl", "xyzzy"))

        assert "Did you mean 'oracle'?" in close and "Known:" not in close
        assert "Did you mean" not in far and "cue_blind" in far

    def test_an_unknown_task(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "Did you mean 'ShellGameTouch-v0'" in mistake(capsys, "show", "ShellGameTuch-v0")

    def test_an_unknown_configuration(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "no configs/*.yaml 'dmeo'. Did you mean 'demo'" in mistake(capsys, "eval", "dmeo")

    def test_eval_of_nothing(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "--task is missing. Example: mikasa-vla eval --task" in mistake(capsys, "eval")
        assert "--policy is missing" in mistake(capsys, "eval", "--task", "RememberColor3-v0")

    def test_an_override_of_a_field_that_is_not_there(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "Did you mean 'delay'" in mistake(capsys, "eval", "demo", "--set", "chunking.delay_step=1")

    def test_a_baseline_that_is_not_evaluated(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "Did you mean 'random'" in mistake(capsys, "eval", "demo", "--baseline", "randon")

    def test_workers_that_are_no_number(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "expected 'auto' or a number, found 'many'" in mistake(
            capsys, "eval", "demo", "--workers", "many"
        )

    def test_a_list_of_what_there_is_not(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert "invalid choice: 'robot'" in mistake(capsys, "list", "robot")

    def test_an_interrupt_has_the_shell_s_exit_code(
        self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def interrupt(_args: object) -> int:
            raise KeyboardInterrupt

        monkeypatch.setattr("vla_eval.cli.list.run", interrupt)

        assert run(capsys, "list") == (130, "", "")


def test_without_arguments_it_names_three_commands(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys)
    assert (code, err) == (0, "")
    assert len([line for line in out.splitlines() if line.startswith("  mikasa-vla ")]) == 3
    for words in re.findall(r"^  mikasa-vla (.*)$", out, re.M):  # they can be typed as they stand
        build_parser((words.split()[0],)).parse_args(words.split())


class TestList:
    def test_everything_is_listed(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, out, _ = run(capsys, "list")

        assert code == 0
        for name in (*TASKS, *list_recipes("policies"), *list_recipes("configs"), *list_recipes("prompts")):
            assert f"  {name} " in out

    def test_one_kind_is_listed_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        _, out, _ = run(capsys, "list", "tasks")

        lines = [line for line in out.splitlines() if not line.endswith(":")]
        assert [line.split()[0] for line in lines] == list(TASKS)

    def test_a_broken_recipe_does_not_hide_the_others(
        self, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "policies").mkdir()
        (tmp_path / "policies" / "mine.yaml").write_text("adaptor: random\n")
        monkeypatch.chdir(tmp_path)

        code, out, _ = run(capsys, "list", "policies")

        assert code == 0
        assert "CANNOT BE READ: policies/mine.yaml: there is no field 'adaptor'" in out
        assert "oracle " in out

    def test_policies_are_grouped_by_what_has_to_be_done_before_they_are_evaluated(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        _, out, _ = run(capsys, "list", "policies")

        group_of, group = {}, ""
        for line in out.splitlines():
            if line.startswith("  "):
                group_of[line.split()[0]] = group
            else:
                group = line
        assert group_of["oracle"] == group_of["tour"] == "baselines and controls:"
        assert group_of["memory_color3"] == "ready to evaluate:"
        scratch = {group_of[name] for name in ("act", "memory", "recurrent_colors")}
        assert scratch == {"to fine-tune, from scratch:"}
        assert group_of["pi0"] == group_of["octo_small"] == "to fine-tune, from a published base:"
        assert group_of["spatialvla_tiny"].startswith("for tests")


class TestShow:
    @pytest.mark.parametrize("task", list(TASKS))
    def test_a_task_is_explained(self, capsys: pytest.CaptureFixture[str], task: str) -> None:
        code, out, _ = run(capsys, "show", task)

        assert code == 0
        for label in ("asks", "instruction", "success", "chance", "horizon", "phases", "arguments"):
            assert f"\n{label} " in out

    def test_arguments_are_those_of_the_row_of_its_class_and_of_its_bases(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        names = [argument.name for argument in task_arguments(task_spec("RememberColor5-v0").entry_point)]
        _, out, _ = run(capsys, "show", "RememberColor5-v0")

        assert {"n_items", "strict_choice", "cue_steps", "freeze_until_choice"} <= set(names)
        assert len(names) == len(set(names))
        assert "n_items = 5" in out
        assert "cube_half_size_m = 0.02 " in out  # ManiSkill's 2 cm, which the class names by a constant

    @pytest.mark.parametrize("task", list(TASKS))
    def test_an_argument_is_shown_with_a_value_and_only_if_one_can_give_it(
        self, capsys: pytest.CaptureFixture[str], task: str
    ) -> None:
        _, out, _ = run(capsys, "show", task)

        assert not re.search(r" = [A-Z][A-Z]|required", out)


PROBE = """
import json, sys
from vla_eval.cli.main import main
try:
    code = main(sys.argv[1:])
except SystemExit as exc:
    code = exc.code
print(json.dumps([code, sorted({name.partition(".")[0] for name in sys.modules})]), file=sys.stderr)
"""


@pytest.mark.parametrize(
    "arguments", [["--help"], ["eval", "--help"], ["list"], ["show", "RememberColor3-v0"]]
)
def test_no_simulator_and_no_model_library_is_imported_for_a_look(
    arguments: list[str], tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROBE, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    code, modules = json.loads(done.stderr.splitlines()[-1])

    assert code == 0
    assert not set(HEAVY) & set(modules)


@pytest.mark.parametrize("is_linked", [True, False])
def test_a_command_may_write_to_what_a_user_linked_into_runs(
    is_linked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table writes to `runs/NAME` without being asked; that folder may lie on another disk."""
    disk = tmp_path / "disk"
    disk.mkdir()
    (tmp_path / "work/runs").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    if is_linked:
        Path("runs/table").symlink_to(disk)

    class Writes:
        @staticmethod
        def add_arguments(parser: argparse.ArgumentParser) -> None:
            """Take none."""

        @staticmethod
        def run(args: argparse.Namespace) -> int:
            (Path("runs/table" if is_linked else disk) / "inside").mkdir()
            return 0

    monkeypatch.setattr("vla_eval.cli.main._verb", lambda _name: Writes)
    assert main(["doctor"]) == (0 if is_linked else 1)
    assert [path.name for path in disk.iterdir()] == (["inside"] if is_linked else [])
    assert ("refused to write" in capsys.readouterr().err) is not is_linked
