"""`show` explains whatever is named, and suggests names of all kinds."""

from pathlib import Path

import pytest

from vla_eval.cli.main import main


@pytest.mark.parametrize(
    ("name", "first", "words"),
    [
        ("smolvla", "policy        smolvla (", "mikasa-vla finetune --policy smolvla --dataset DIR"),
        ("oracle", "policy        oracle (", "mikasa-vla check oracle"),
        ("policies/oracle.yaml", "policy        oracle (", "adapter:"),
        ("demo", "config        demo (", "mikasa-vla eval demo"),
        ("paper_vla_table", "config        paper_vla_table (", "mikasa-vla finetune paper_vla_table"),
        ("leaderboard_mikasa", "protocol      leaderboard_mikasa (", "--protocol leaderboard_mikasa"),
        ("RememberColor3", "task          RememberColor3-v0 (", "chance"),
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
            assert f"{file.stem} (" in capsys.readouterr().out


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
