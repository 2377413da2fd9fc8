"""Whatever is given to `--set`, it changes that field, or is refused with one message."""

import dataclasses
import json
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.recipe_cases import FRAGMENTS, ODD_SCALARS, outcome, plain, yaml_text
from vla_eval.cli.main import main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides, to_data
from vla_eval.config.finetuning import FinetuneRecipe
from vla_eval.strict.decoding import decode

BASES: dict[type[Any], dict[str, Any]] = {
    EvalConfig: {"name": "x", "tasks": ["RememberColor3-v0"], "policies": ["random"]},
    DatasetRecipe: {"name": "x", "tasks": ["RememberColor3-v0"]},
    FinetuneRecipe: {"type": "act", "base_checkpoint": "b", "lora": None},
}
COMMANDS = (
    ("eval", "--task", "RememberColor3-v0", "--policy", "random"),
    ("audit", "--task", "RememberColor3-v0"),
    ("record", "--task", "RememberColor3-v0"),
)
INNER = ("mode", "delay_steps", "video", "step_seconds", "rank", "a", "a.b", "n_items", "", "x" * 300)

fields = st.sampled_from(sorted({field.name for cls in BASES for field in dataclasses.fields(cls)}))
paths = fields | st.tuples(fields, st.sampled_from(INNER)).map(".".join) | st.text(max_size=12)
values = (
    st.sampled_from(ODD_SCALARS)
    | st.sampled_from(FRAGMENTS)
    | yaml_text
    | st.text(max_size=12)
    | plain.map(lambda value: yaml.safe_dump(value, default_flow_style=True))
    | plain.map(json.dumps)
)
overrides = st.lists(st.tuples(paths, values).map("=".join) | st.text(max_size=12), min_size=1, max_size=3)


@given(cls=st.sampled_from(list(BASES)), overrides=overrides)
def test_any_value_of_any_field(cls: type[Any], overrides: list[str]) -> None:
    data = json.loads(json.dumps(BASES[cls]))
    if outcome(lambda: apply_overrides(data, overrides, cls=cls) or True) is None:
        return

    found = outcome(lambda: decode(cls, data, where="command line"))

    if found is not None:
        assert decode(cls, json.loads(json.dumps(to_data(found), allow_nan=False)), where="stored") == found


@given(cls=st.sampled_from(list(BASES)), data=st.data())
def test_a_value_that_is_taken_is_the_one_that_was_given(cls: type[Any], data: st.DataObject) -> None:
    number = data.draw(st.integers(1, 400) | st.floats(0.25, 2.0).map(lambda x: round(x, 3)))
    kinds = get_type_hints(cls)  # without the bounds
    whole = sorted(f.name for f in dataclasses.fields(cls) if kinds[f.name] in (int, float))
    name = data.draw(st.sampled_from(whole))
    changed = dict(BASES[cls])

    apply_overrides(changed, [f"{name}={number}"], cls=cls)
    found = outcome(lambda: decode(cls, changed, where="command line"))

    assert found is None or getattr(found, name) == number


@given(command=st.sampled_from(COMMANDS), overrides=overrides)
def test_a_command_answers_with_one_message(
    command: tuple[str, ...],
    overrides: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def begun(*_: object, **__: object) -> None:
        raise KeyboardInterrupt  # nothing is run here

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vla_eval.cli.terminal.progress.evaluate_with_progress", begun)
    monkeypatch.setattr("vla_eval.data.recording.record.record", begun)

    code = main([*command, *(f"--set={override}" for override in overrides)])

    error = capsys.readouterr().err
    assert code in (1, 130)
    assert error.startswith("mikasa-vla: error: ") if code == 1 else not error
    assert not list(tmp_path.iterdir())
