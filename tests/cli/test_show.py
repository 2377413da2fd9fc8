"""`show` explains whatever is named, and suggests names of all kinds."""

import shutil
from pathlib import Path

import pytest

from tests.results.stored_runs import episodes, stored
from vla_eval.cli.main import main
from vla_eval.storage.run_folder import RunFolder


@pytest.mark.parametrize(
    ("name", "first", "words"),
    [
        ("smolvla", "policy        smolvla", "mikasa-vla finetune --policy smolvla --dataset DIR"),
        ("oracle", "policy        oracle", "mikasa-vla check oracle"),
        ("policies/oracle.yaml", "policy        oracle", "adapter:"),
        ("demo", "config        demo", "mikasa-vla eval demo"),
        ("paper_vla_table", "config        paper_vla_table", "mikasa-vla finetune paper_vla_table"),
        ("leaderboard_mikasa", "protocol      leaderboard_mikasa", "--protocol leaderboard_mikasa"),
        ("RememberColor3", "task          RememberColor3-v0", "chance"),
    ],
)
def test_whatever_is_named_is_shown(
    name: str, first: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", name]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(first)
    assert words in shown


def test_every_recipe_can_be_shown(capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("policies", "configs", "datasets", "protocols"):
        for file in sorted(Path(folder).glob("*.yaml")):
            assert main(["show", f"{folder}/{file.name}"]) == 0
            said = capsys.readouterr().out
            assert file.stem in said.splitlines()[0]
            assert f"/{file.name}\n" in said


def test_a_path_is_never_broken_however_long_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    deep = tmp_path / "a folder whose name has spaces" / ("and-is-long-" * 12) / "configs"
    deep.mkdir(parents=True)
    recipe = deep / "mine.yaml"
    recipe.write_bytes(Path("configs/demo.yaml").read_bytes())
    assert main(["show", str(recipe)]) == 0
    assert f" {recipe}\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("recipe", "word"),
    [
        ("configs/demo", "config"),
        ("configs/paper_vla_table", "config"),
        ("policies/act", "policy"),
        ("policies/oracle", "policy"),
        ("datasets/positive_control", "dataset"),
        ("protocols/leaderboard_mikasa", "protocol"),
    ],
)
def test_a_file_in_any_folder_is_shown_as_what_its_fields_are(
    recipe: str, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "mine.yaml"
    copy.write_bytes(Path(f"{recipe}.yaml").read_bytes())
    assert main(["show", str(copy)]) == 0
    assert capsys.readouterr().out.startswith(f"{word:14}mine")


def test_a_file_with_fields_of_no_kind_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.yaml").write_text("adapter: oracle\ntasks: []\n", encoding="utf-8")
    assert main(["show", str(tmp_path / "mine.yaml")]) == 1
    assert "no kind of recipe has all of its fields (adapter, tasks)" in capsys.readouterr().err


def test_a_path_to_nowhere_lists_no_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "nowhere/mine.yaml"]) == 1
    said = capsys.readouterr().err
    assert "there is no such file or folder" in said and len(said) < 400


class TestFolders:
    def test_a_checkpoint(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["show", "checkpoints/memory_color3"]) == 0
        shown = capsys.readouterr().out
        assert shown.startswith("checkpoint    checkpoints/memory_color3\n")
        assert "mikasa-vla checkpoint verify checkpoints/memory_color3\n" in shown

    def test_a_run_and_the_commands_quote_its_path(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        folder = tmp_path / "my runs"
        with RunFolder.open(folder, stored([]).description) as run:
            for one in episodes("p", "+-", first_choice=0):
                run.append(one)
        assert main(["show", str(folder)]) == 0
        shown = capsys.readouterr().out
        assert "episodes      1 failure, 1 success\n" in shown
        assert f"mikasa-vla report '{folder}'\n" in shown

    def test_a_dataset(self, recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["show", str(recorded)]) == 0
        shown = capsys.readouterr().out
        assert "about         a recording of RememberColor3-v0, complete\n" in shown
        assert "episodes      4, " in shown
        assert f"mikasa-vla finetune --policy RECIPE --dataset {recorded}\n" in shown

    def test_a_dataset_of_another_program(self, recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
        shutil.rmtree(recorded / "meta/mikasa")
        assert main(["show", str(recorded)]) == 0
        assert "a LeRobotDataset of another program" in capsys.readouterr().out

    def test_any_other_folder_says_what_was_expected(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["show", "docs"]) == 1
        said = capsys.readouterr().err
        assert "expected a run (run.json), a training (finetune.json), a dataset (meta/info.json)" in said


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("smolvle", "smolvla"),
        ("RememberColour3-v0", "RememberColor3-v0"),
        ("leaderbord_mikasa", "leaderboard"),
    ],
)
def test_the_closest_name_of_any_kind_is_suggested(
    name: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", name]) == 1
    said = capsys.readouterr().err
    assert f"Did you mean '{meant}" in said
    assert len(said) < 300  # no list of all names
