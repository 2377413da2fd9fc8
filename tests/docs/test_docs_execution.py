"""Each command of README and docs is executed, on stand-ins for what it names; or it is listed why not.

`eval` is a dry run: it refuses what the run would refuse. Folders of checkpoints are copies of a shipped one,
run folders copies of a small run on the fake simulator.
"""

import itertools
import shutil
from pathlib import Path

import pytest

from tests.docs.test_docs_commands import OURS, ROOT, Command
from vla_eval.cli.main import main
from vla_eval.config.files import list_recipes
from vla_eval.evaluation.model_table import is_model_table
from vla_eval.storage.planned import named_checkpoints

NOT_EXECUTED = {
    "audit": "simulates for hours; tests/audit",
    "check": "is given a policy of its page; tests/cli/test_check.py",
    "bench": "measures this machine; tests/bench",
    "checkpoint": "reads published files or the network; tests/checkpoints",
    "dataset": "reads recorded or published datasets; tests/data",
    "finetune": "trains for hours; the names in it are looked up; tests/training",
    "merge": "reads shards that other commands made; tests/cli/test_merge.py",
    "probe": "simulates for hours; tests/probe",
    "record": "simulates for hours; the names in it are looked up; tests/data",
    "replay": "simulates; tests/data",
    "serve": "runs until it is stopped; tests/cli/test_serve.py",
    "view": "opens a viewer; tests/cli/test_view.py",
}
"""Verb -> why its commands are parsed only, and which tests run it at small scale."""
NEEDED = {
    "ws://": "a policy server; tests/evaluation/test_remote_runs.py",
    "hub:": "the Hub; tests/checkpoints/test_fetching.py",
    "--cluster": "Ray; tests/evaluation/test_evaluate_on_cluster.py",
    "--filmstrip": "captured episodes; tests/viz",
}
"""Part of a command -> what it needs, and which tests have it."""


TABLES = "trained checkpoints; tests/evaluation/test_model_table.py"


def why_not(command: Command) -> str | None:
    """Return why a command is not executed here; None: it is."""
    words = command.words
    if words[1] == "eval" and not words[2].startswith("-") and is_model_table(words[2]):
        return TABLES
    needs = next((why for part, why in NEEDED.items() if any(part in word for word in words)), None)
    return needs or NOT_EXECUTED.get(words[1])


EXECUTED = [command for command in OURS if why_not(command) is None]


def test_every_verb_of_the_docs_is_executed_or_says_why_not() -> None:
    executed = {command.words[1] for command in EXECUTED}
    assert executed >= {"eval", "report", "compare", "list", "show"}
    assert executed.isdisjoint(NOT_EXECUTED)
    assert len(EXECUTED) > len(OURS) / 3


def test_the_tests_that_are_named_instead_exist() -> None:
    for why in (*NOT_EXECUTED.values(), *NEEDED.values(), TABLES):
        assert (ROOT / "tests" / why.rpartition("tests/")[2]).exists(), why


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the policies that pages compare with."""
    folder = tmp_path_factory.mktemp("docs") / "run"
    named = ("memoryless=hold", "memoryless_color3=hold", "memoryless_free=hold")
    policies = ("random", "cue_blind", "oracle", *named)
    own = ("--task", "RememberColor3-v0", "--episodes", "2", "--n-action-steps", "1", "4", "--workers", "1")
    assert main(["eval", *own, "--policy", *policies, "--set", "simulator=fake", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("command", EXECUTED, ids=str)
def test_a_command_of_the_docs_is_executed(
    command: Command,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    verb, *words = command.words[1:]
    for path in filter(_is_missing, _checkpoints(words) if verb == "eval" else ()):
        shutil.copytree(ROOT / "checkpoints" / "memory_color3", path)
        (Path(path) / "name.txt").write_text(path)  # each is another one
    for path in filter(_is_missing, words if verb in ("report", "compare") else ()):
        shutil.copytree(run, path)
    code = main([verb, *words, *(("--dry-run",) if verb == "eval" else ())])
    said = capsys.readouterr()
    assert code == 0, said.err
    assert said.out


def _checkpoints(words: list[str]) -> list[str]:
    """Return what `--policy` names."""
    after = words[words.index("--policy") + 1 :] if "--policy" in words else []
    texts = list(itertools.takewhile(lambda word: not word.startswith("--"), after))
    named = [named_checkpoints(text) for text in texts]
    pairs = zip(texts, named, strict=True)
    return [one for text, of in pairs for one in (of.checkpoints if of is not None else (text,))]


def _is_missing(word: str) -> bool:
    """Whether it is the path of a folder that a reader has and the test has not."""
    is_path = "/" in word or word.isupper()
    return is_path and not Path(word).exists() and word not in list_recipes("policies") and "=" not in word
