"""Whatever a recipe file holds, it is read as what it says, or refused with one message."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.evaluation.resolved import fingerprint, make_plan
from tests.fuzz.recipe_cases import changed_recipe, damaged_text, outcome, shipped, yaml_text
from vla_eval.cli.main import main
from vla_eval.config.agents import AgentTable
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import Folder, Recipe, load_recipe, to_data
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import PromptRecipe
from vla_eval.data.recording.plan import plan_recording
from vla_eval.evaluation.model_table import ModelTable, finetunings, is_model_table
from vla_eval.strict.decoding import decode, load_yaml

TASK = "RememberColor3-v0"
FEW_EPISODES = 1000  # a longer plan takes seconds and is no other
CLASSES: dict[Folder, tuple[type[Any], ...]] = {
    "configs": (EvalConfig, ModelTable, AgentTable, FinetuneConfig),
    "policies": (PolicyRecipe,),
    "prompts": (PromptRecipe,),
    "datasets": (DatasetRecipe,),
}
folders = st.sampled_from(sorted(CLASSES))


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "own.yaml"


def read(folder: Folder, content: bytes, path: Path) -> None:
    """Read a recipe as the command line does, and use what can be read."""
    path.write_bytes(content)
    if folder == "configs":
        outcome(lambda: is_model_table(str(path)))
    for cls in CLASSES[folder]:
        found = outcome(lambda cls=cls: load_recipe(folder, str(path), cls))
        if found is not None:
            use(found)


def use(recipe: Recipe[Any]) -> None:
    """Do what begins every command; a recipe that is read can be stored and read again."""
    value = recipe.value
    stored = json.loads(json.dumps(to_data(value), allow_nan=False))
    assert decode(type(value), stored, where="stored") == value
    match value:
        case EvalConfig() if value.episodes * value.runs <= FEW_EPISODES:
            outcome(lambda: fingerprint(value))
            outcome(lambda: make_plan(value))
        case DatasetRecipe():
            outcome(lambda: plan_recording(value))
        case ModelTable():
            outcome(lambda: finetunings(value, Path("out")))
        case PolicyRecipe():
            outcome(lambda: make_plan(EvalConfig(name="x", tasks=(TASK,), policies=(str(recipe.path),))))


@given(data=st.data(), folder=folders)
def test_a_shipped_recipe_with_changed_fields(folder: Folder, recipe: Path, data: st.DataObject) -> None:
    read(folder, data.draw(changed_recipe(folder)).encode(), recipe)


@given(data=st.data(), folder=folders)
def test_a_shipped_recipe_with_damaged_text(folder: Folder, recipe: Path, data: st.DataObject) -> None:
    read(folder, data.draw(damaged_text(folder)).encode("utf-8", "surrogatepass"), recipe)


@given(text=yaml_text | st.text())
def test_any_text(text: str) -> None:
    found = outcome(lambda: load_yaml(text, where="x"))
    json.dumps(found)


@given(content=st.binary())
def test_any_bytes(recipe: Path, content: bytes) -> None:
    read("configs", content, recipe)


@pytest.mark.parametrize("folder", CLASSES)
def test_every_kind_of_recipe_is_among_the_cases(folder: Folder, recipe: Path) -> None:
    for text in shipped(folder):
        recipe.write_text(text, encoding="utf-8")
        assert any(outcome(lambda cls=cls: load_recipe(folder, "own.yaml", cls)) for cls in CLASSES[folder])


@pytest.mark.parametrize(
    "changed",
    [{"tasks": ("RememberColour3-v0",)}, {"policies": ("orracle",)}, {"env": {"meshes": "nowhere"}}],
    ids=str,
)
def test_what_only_a_look_outside_the_file_refuses(changed: dict[str, Any]) -> None:
    """These are read as text; tasks, policies and folders are looked up when the recipe is used."""
    value = EvalConfig(**({"name": "x", "tasks": ("RememberObject3-v0",), "policies": ("oracle",)} | changed))
    assert outcome(lambda: fingerprint(value)) is None
    use(Recipe(name="x", path=Path("x.yaml"), sha256="0" * 64, value=value))


class TestCommandLine:
    @pytest.fixture(autouse=True)
    def _run_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Stop where an evaluation would begin: plans are made above."""

        def begun(*_: object, **__: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("vla_eval.cli.terminal.progress.evaluate_with_progress", begun)

    @given(text=changed_recipe("configs") | damaged_text("configs"))
    def test_a_command_answers_with_one_message(
        self, recipe: Path, capsys: pytest.CaptureFixture[str], text: str
    ) -> None:
        recipe.write_bytes(text.encode("utf-8", "surrogatepass"))

        code = main(["eval", "own.yaml"])

        error = capsys.readouterr().err
        assert code in (1, 130)
        assert error.startswith("mikasa-vla: error: ") if code == 1 else not error
        assert "Traceback" not in error
        assert [path.name for path in recipe.parent.iterdir()] == ["own.yaml"]
