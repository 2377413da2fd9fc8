"""What `report --export` writes is what its schema and its page say."""

import copy
import json
from pathlib import Path

import jsonschema
import pytest

from tests.results.stored_runs import episodes, stored
from tests.testing.script_files import load_script
from vla_eval.cli.main import main
from vla_eval.results.exported.file import ROW_FIELDS, export_schema, export_text
from vla_eval.results.passport.fields import FIELDS
from vla_eval.results.report import build_table
from vla_eval.storage.run_folder import StoredRun

DOCS = Path(__file__).parents[2] / "docs"
TABLES: dict[str, list[StoredRun]] = {
    "one run": [stored(episodes("p", "++-e"), episodes("cue_blind", "-+--"))],
    "several runs": [stored(episodes("p", "++-"), episodes("p", "+--", run=1), episodes("p", "+++", run=2))],
    "two folders": [
        stored(episodes("p", "++"), env={"delay_steps": 5}),
        stored(episodes("p", "--"), path="runs/b", env={"delay_steps": 20}),
    ],
    "errors alone": [stored(episodes("p", "ee"))],
}


@pytest.mark.parametrize("name", TABLES)
def test_what_is_written_is_valid(name: str) -> None:
    table = build_table(TABLES[name])
    data = json.loads(export_text(table))
    jsonschema.Draft202012Validator(export_schema()).validate(data)
    assert len(data["rows"]) == len(table.rows)
    for one, row in zip(data["rows"], table.rows, strict=True):
        values = row.to_dict()
        assert {field.name: one[field.name] for field in ROW_FIELDS}.items() <= values.items()
        assert list(one["passport"]) == [field.name for field in FIELDS]


def test_the_schema_refuses_what_is_not_so() -> None:
    validator = jsonschema.Draft202012Validator(export_schema())
    jsonschema.Draft202012Validator.check_schema(export_schema())
    data = json.loads(export_text(build_table(TABLES["one run"])))
    for path, value in (("success_once", 1.5), ("n_episodes", -1), ("interval", "guess"), ("task", None)):
        wrong = copy.deepcopy(data)
        wrong["rows"][0][path] = value
        assert not validator.is_valid(wrong), path
    for key in ("passport", "n_success_once"):
        wrong = copy.deepcopy(data)
        del wrong["rows"][0][key]
        assert not validator.is_valid(wrong), key
    assert not validator.is_valid({**data, "more": 1})


def test_schema_and_page_are_what_the_script_writes() -> None:
    script = load_script("results_schema")
    assert (DOCS / script.SCHEMA).read_text(encoding="utf-8") == script.schema_text()
    text = (DOCS / script.PAGE).read_text(encoding="utf-8")
    assert text == script.page(text)


def test_the_command_writes_the_file_and_prints_its_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], in_this_process: None
) -> None:
    run, file = tmp_path / "run", tmp_path / "new" / "results.json"
    command = [
        "eval",
        "--task",
        "RememberColor3-v0",
        "--policy",
        "oracle",
        "--episodes",
        "2",
        "--workers",
        "1",
    ]
    assert main([*command, "--set", "simulator=fake", "--out", str(run)]) == 0
    capsys.readouterr()
    assert main(["report", str(run), "--export", str(file)]) == 0
    assert capsys.readouterr().out == f"{file}\n"
    (row,) = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert (row["policy"], row["n_success_once"], row["passport"]["simulator"]) != (None, None, None)
    assert main(["report", str(run), "--export", str(file), "--format", "csv"]) == 1
    assert "--export writes a file" in capsys.readouterr().err
