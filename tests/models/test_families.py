"""A family of policies is its folder, a row, a recipe and its tests: nothing else knows its name."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from vla_eval.checkpoints.bases import find_base, how_to_get
from vla_eval.checkpoints.conversion import convert_command
from vla_eval.cli.main import main
from vla_eval.evaluation import evaluate as evaluate_module
from vla_eval.evaluation.model_table import TableRow
from vla_eval.models.families import FAMILIES
from vla_eval.storage.run_folder import read_run
from vla_eval.testing.tiny_table import _tiny_recipe

PACKAGE = Path(__file__).parents[2] / "vla_eval"
ROWS = (
    *(PACKAGE / "models" / "families.py", PACKAGE / "models" / "family.py"),
    PACKAGE / "results" / "imported" / "programs.py",  # names of other programs, one of which is a family's
)
WORDS = {"act", "diffusion", "memory", "sequence"}
"""Names of types and of folders that are words of English, too: of these only the modules are looked for."""
SHORT = {"steps": 3, "batch_size": 2, "save_every_steps": 3, "log_every_steps": 1, "num_workers": 0}


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Register the row; workers find the folder by its name, too."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    module = importlib.import_module("toy_family.row")
    monkeypatch.setitem(FAMILIES, module.ROW.type, module.ROW)
    return module


@pytest.fixture
def recipe(toy: ModuleType, tmp_path: Path) -> Path:
    path = tmp_path / "toy.yaml"
    section = {"type": toy.ROW.type, "policy": {"chunk_size": 4, "n_action_steps": 4}, **SHORT}
    path.write_text(
        yaml.safe_dump({"version": 1, "description": "toy", "adapter": "lerobot", "finetune": section})
    )
    return path


class TestToyFamily:
    def test_it_is_estimated_trained_verified_and_evaluated(
        self,
        toy: ModuleType,
        recipe: Path,
        recorded: Path,
        no_network: None,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        finetune = ["finetune", "--policy", str(recipe), "--dataset", str(recorded), "--device", "cpu"]
        assert main([*finetune, "--allow-unreplayed", "--dry-run"]) == 0
        n_parameters = (10 + 1) * 4 * 7  # the state eef, a bias; a chunk of 4 actions
        printed = capsys.readouterr().out
        assert f"trained: {n_parameters} of {n_parameters} parameters" in printed and "TFLOP/s" in printed
        run = tmp_path / "run"
        assert main([*finetune, "--allow-unreplayed", "--out", str(run)]) == 0
        assert main(["checkpoint", "verify", str(run)]) == 0
        assert "mikasa_toy" in capsys.readouterr().out

        monkeypatch.setattr(evaluate_module, "RUNNER", f"{toy.__name__}:toy_runner")
        out = tmp_path / "evaluation"
        evaluation = ["eval", "--task", "RememberColor3-v0", "--policy", str(run), "--workers", "1"]
        evaluation += ["--episodes", "2", "--set", "simulator=fake", "--set", "env.horizon_steps=12"]
        assert main([*evaluation, "--out", str(out)]) == 0
        assert [(record.policy, record.error) for record in read_run(out).records] == [
            ("run-000003", None),
            ("run-000003", None),
        ]

    def test_its_published_checkpoint_is_found_and_converted_by_a_verb_of_its_own(
        self, toy: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        source, out = tmp_path / "published", tmp_path / "ours"
        source.mkdir()
        weights = {"head.weight": torch.ones(8 * 7, 3), "head.bias": torch.zeros(8 * 7)}
        save_file(weights, source / "model.safetensors")
        command = convert_command(find_base("toy_base"), source, out)
        assert command == f"mikasa-vla checkpoint convert-toy {source} --scale 2.0 --out {out}"
        assert "checkpoint fetch toy_base" in how_to_get("checkpoints/toy_base")
        assert main(command.split()[1:]) == 0
        assert load_file(out / "model.safetensors")["head.weight"].unique().tolist() == [2.0]
        with pytest.raises(SystemExit):
            main(["checkpoint", "--help"])
        assert "convert-toy" in capsys.readouterr().out

    def test_it_has_a_row_in_tables_of_tiny_models(self, recipe: Path, tmp_path: Path) -> None:
        row = TableRow(name="toy", policy=str(recipe), n_action_steps=(2,))
        made, adapter = _tiny_recipe(row, tmp_path)
        assert adapter == "lerobot" and made["finetune"]["policy"]["chunk_size"] == 2


def _code(file: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of identifiers and strings, docstrings aside."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    documents = {
        id(statement.value)
        for node in ast.walk(tree)
        if isinstance(body := getattr(node, "body", None), list)
        for statement in body
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    }
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents:
            yield line, node.value
        for name in ("id", "attr", "arg", "name", "module", "asname"):
            if isinstance(value := getattr(node, name, None), str):
                yield line, value


def test_no_other_code_names_a_family() -> None:
    folders = {row.configuration.split(".")[2] for row in FAMILIES.values() if row.configuration}
    names = {*FAMILIES, *folders} - WORDS
    # As a word by itself: `paper_openvla` is a value that checkpoints hold.
    pattern = re.compile(
        rf"(?<![\w])({'|'.join(map(re.escape, sorted(names)))})(?![\w])|models[./]({'|'.join(folders)})\b"
    )
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).parts
        if file in ROWS or (parts[0] == "models" and parts[1] in folders):
            continue
        for line, text in _code(file):
            if pattern.search(text):
                found.append(f"{file.relative_to(PACKAGE)}:{line}: {text[:80]}")
    assert found == []


def test_no_family_names_another_one() -> None:
    """A folder may name what it wraps, and build upon another family's modules."""
    for row in FAMILIES.values():
        if not row.configuration:
            continue
        folder = row.configuration.split(".")[2]
        own = {other.type for other in FAMILIES.values() if other.configuration == row.configuration}
        wrapped = {FAMILIES[kind].wraps for kind in own}
        others = {*FAMILIES, "octo", "openvla", "spatialvla"} - own - wrapped - WORDS - {folder}
        pattern = re.compile(rf"(?<!\w)({'|'.join(map(re.escape, sorted(others)))})(?!\w)")
        for file in (PACKAGE / "models" / folder).glob("*.py"):
            assert not [text for _, text in _code(file) if pattern.search(text)], file
