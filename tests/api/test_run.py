"""What `load_run` gives: the verbs' tables, data frames, a page, and what a notebook shows."""

import subprocess
import sys
from pathlib import Path

import pytest

import vla_eval
from vla_eval.cli.main import main
from vla_eval.errors import RunFolderError, UnknownNameError, VlaEvalError

TASK = "RememberColor3-v0"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> vla_eval.Run:
    return vla_eval.evaluate(
        policy=["oracle", "cue_blind"],
        tasks=TASK,
        n_action_steps=[1, 4],
        episodes=4,
        simulator="fake",
        in_process=True,
        out=tmp_path_factory.mktemp("runs") / "run",
    )


def test_tables_are_those_of_the_verbs(run: vla_eval.Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run.path), "--format", "csv"]) == 0
    assert run.table("csv") == capsys.readouterr().out.removesuffix("\n")
    assert main(["compare", str(run.path), "--format", "json"]) == 0
    assert run.compare(format="json") == capsys.readouterr().out.removesuffix("\n")
    assert repr(run.table()) == run.table()


def test_data_frames_have_a_row_per_row_and_per_episode(run: vla_eval.Run) -> None:
    rows, episodes = run.to_pandas(), run.to_pandas("episodes")
    assert list(rows["policy"]) == ["oracle", "oracle", "cue_blind", "cue_blind"]
    assert len(episodes) == 16 and set(episodes["seed"]) == {1, 2, 3, 4}
    assert rows["success_once"].iloc[0] == episodes[episodes["policy"] == "oracle"]["success_once"].mean()
    assert list(episodes["error_kind"].unique()) == [None]
    with pytest.raises(UnknownNameError, match="episodes"):
        run.to_pandas("episode")  # type: ignore[arg-type]


def test_a_notebook_shows_table_verdict_and_plot(run: vla_eval.Run) -> None:
    html = run._repr_html_()
    assert "<table" in html and "oracle" in html and "<svg" in html and "--c0: #0072b2" in html


def test_a_page_is_written_beside_the_run(run: vla_eval.Run) -> None:
    assert run.page() == run.path.with_name("run-report") / "index.html"
    assert run.page().is_file()


def test_several_folders_are_one_table(run: vla_eval.Run) -> None:
    assert len(vla_eval.load_run(run.path, str(run.path)).to_pandas()) == 4
    with pytest.raises(RunFolderError):
        vla_eval.load_run(run.path.parent / "nothing")


def test_every_name_is_there_and_importing_the_package_imports_nothing() -> None:
    for name in vla_eval._PLACES:
        assert name in dir(vla_eval) and getattr(vla_eval, name).__doc__
    with pytest.raises(AttributeError, match="evaluat"):
        vla_eval.evaluat  # noqa: B018
    code = "import sys, vla_eval; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    found = {name.partition(".")[0] for name in done.stdout.split() if not name.startswith("_")}
    assert [name for name in done.stdout.split() if name.startswith("vla_eval")] == ["vla_eval"]
    assert not {"numpy", "torch", "pandas", "scipy"} & found


def test_the_stub_has_the_names_that_are_offered() -> None:
    stub = Path(vla_eval.__file__).with_suffix(".pyi").read_text()
    assert {line.split(" as ")[1] for line in stub.splitlines() if " as " in line} == set(vla_eval._PLACES)


def test_names_of_tasks_and_policies_are_listed() -> None:
    assert TASK in vla_eval.list_tasks() and "oracle" in vla_eval.list_policies()


def test_only_markdown_is_offered_to_notebooks_as_markdown(run: vla_eval.Run) -> None:
    assert run.table()._repr_markdown_() == str(run.table())
    assert run.table("latex")._repr_markdown_() is None  # IPython then shows the text
    assert repr(run.table("csv")) == str(run.table("csv"))


def test_a_word_that_is_no_format_and_no_comparison_is_refused(run: vla_eval.Run) -> None:
    with pytest.raises(VlaEvalError, match="no format 'text'"):
        run.table("text")  # type: ignore[arg-type]
    with pytest.raises(VlaEvalError, match="way to compare 'k'"):
        run.compare(by="k")  # type: ignore[arg-type]
