"""Each field of LeRobot's configurations has an answer: honoured, translated, or ignored and named.

The fields come from the installed LeRobot, and where it reads them from its code.
"""

import ast
import dataclasses
import functools
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import PreTrainedConfig

from tests.checkpoints import small_checkpoints
from tests.checkpoints.small_checkpoints import act_config, context_for, copied
from tests.evaluation.resolved import make_plan
from tests.training.lerobot_tiny import lerobots_types
from vla_eval.checkpoints.execution_fields import EXECUTION_FIELDS, ignored_fields, without_execution
from vla_eval.checkpoints.files import CONFIG_FILE
from vla_eval.checkpoints.loading import LoadOptions, load_checkpoint
from vla_eval.checkpoints.policy_types import chunk_size
from vla_eval.chunking import ChunkingSettings
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.models.families import FAMILIES
from vla_eval.policies.lerobot.policy import make_lerobot
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.specs import EnvSpec

KNOWN_FIELDS = Path(__file__).with_name("lerobot_fields.txt")
LOOP = ("select_action", "reset")
ASKED_FOR_STEPS = {kind: family.queues for kind, family in FAMILIES.items() if family.queues}
WITHOUT_CHUNKS = {*ASKED_FOR_STEPS, *(kind for kind, family in FAMILIES.items() if family.why_not)}
CUT_THEIR_CHUNK = {kind for kind, family in FAMILIES.items() if family.cuts_chunk}
backbone, env, act = small_checkpoints.backbone, small_checkpoints.env, small_checkpoints.act


def fields_of(kind: str) -> set[str]:
    return {field.name for field in dataclasses.fields(PreTrainedConfig.get_choice_class(kind))}


class Reads(ast.NodeVisitor):
    """Which attributes of `config` and which own methods a function names."""

    def __init__(self) -> None:
        self.fields: set[str] = set()
        self.calls: set[str] = set()

    def visit_Attribute(self, node: ast.Attribute) -> None:
        owner = node.value.attr if isinstance(node.value, ast.Attribute) else getattr(node.value, "id", None)
        if owner == "config":
            self.fields.add(node.attr)
        elif owner == "self":
            self.calls.add(node.attr)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        if getattr(node.func, "id", None) == "getattr" and isinstance(node.args[1], ast.Constant):
            self.fields.add(str(node.args[1].value))
        self.generic_visit(node)


@functools.cache
def code_of(kind: str) -> ast.Module:
    name = PreTrainedConfig.get_choice_class(kind).__module__.replace("configuration_", "modeling_")
    spec = importlib.util.find_spec(name)
    assert spec is not None and spec.origin is not None
    return ast.parse(Path(spec.origin).read_text())


def methods(kind: str) -> Iterator[tuple[str, str, Reads]]:
    """Yield class, method and what it reads, of the classes in a policy's module."""
    for cls in (node for node in ast.walk(code_of(kind)) if isinstance(node, ast.ClassDef)):
        for function in (node for node in cls.body if isinstance(node, ast.FunctionDef)):
            reads = Reads()
            reads.visit(function)
            yield cls.name, function.name, reads


def read_from(kind: str, *begin: str) -> set[str]:
    """Return the fields that these methods of the policy's class read, with all that they call."""
    of_policy = {name: reads for cls, name, reads in methods(kind) if cls.endswith("Policy")}
    due, seen = [*begin], set[str]()
    while due:
        name = due.pop()
        if name in of_policy and name not in seen:
            seen.add(name)
            due += of_policy[name].calls
    return {field for name in seen for field in of_policy[name].fields} & fields_of(kind)


def test_each_field_of_the_installed_lerobot_is_known() -> None:
    known = {
        kind: set(names.split())
        for kind, _, names in (line.partition(": ") for line in KNOWN_FIELDS.read_text().splitlines())
    }
    found = {kind: fields_of(kind) for kind in lerobots_types()}
    new = {kind: sorted(names - known.get(kind, set())) for kind, names in found.items()}

    assert {kind: names for kind, names in new.items() if names} == {}, (
        "New fields of LeRobot. Where its own loop alone reads one, it needs a row in EXECUTION_FIELDS; then "
        f"add it to {KNOWN_FIELDS.name}."
    )
    assert known == found


@pytest.mark.parametrize("kind", lerobots_types())
def test_what_only_lerobots_own_loop_reads_is_translated_or_ignored_by_name(kind: str) -> None:
    if kind in WITHOUT_CHUNKS:
        return  # refused, or asked by that loop
    of_its_loop = read_from(kind, *LOOP) - read_from(kind, "predict_action_chunk")
    of_inputs = {"input_features", "output_features"}

    assert of_its_loop - of_inputs <= EXECUTION_FIELDS.keys()


def test_types_that_cut_their_chunk_are_those_whose_inference_reads_the_number_of_steps() -> None:
    cut = {
        kind
        for kind in lerobots_types()
        for _, name, reads in methods(kind)
        if name not in {*LOOP, "__init__", "_resolve_action_queue_steps"} and "n_action_steps" in reads.fields
    }

    assert cut - WITHOUT_CHUNKS == CUT_THEIR_CHUNK


@pytest.mark.parametrize("kind", sorted(ASKED_FOR_STEPS))
def test_what_is_kept_of_an_episode_is_what_the_types_own_reset_empties(kind: str) -> None:
    (reset,) = (
        node
        for cls in ast.walk(code_of(kind))
        if isinstance(cls, ast.ClassDef) and cls.name.endswith("Policy")
        for node in cls.body
        if isinstance(node, ast.FunctionDef) and node.name == "reset"
    )
    emptied = {
        node.attr
        for node in ast.walk(reset)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
    }

    assert emptied == set(ASKED_FOR_STEPS[kind])


@pytest.mark.parametrize("kind", sorted(CUT_THEIR_CHUNK))
def test_of_those_the_whole_chunk_is_asked_for(kind: str) -> None:
    config = PreTrainedConfig.get_choice_class(kind)()
    config.n_action_steps = 1

    assert chunk_size(config) == config.n_action_steps > 1


def test_each_row_is_a_field_of_lerobot_and_has_one_answer() -> None:
    everything = set[str]().union(*(fields_of(kind) for kind in lerobots_types()))

    assert EXECUTION_FIELDS.keys() <= everything
    assert all(bool(answer.translated) != bool(answer.instead) for answer in EXECUTION_FIELDS.values())


@pytest.mark.parametrize("kind", lerobots_types())
def test_what_is_ignored_is_off_by_default_and_nothing_is_said_of_it(kind: str, tmp_path: Path) -> None:
    ignored = [name for name, answer in EXECUTION_FIELDS.items() if answer.translated is None]
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(PreTrainedConfig.get_choice_class(kind))
        if field.name in ignored
    }
    (tmp_path / CONFIG_FILE).write_text(json.dumps({"type": kind, **defaults}))
    (tmp_path / "model.safetensors").touch()

    assert without_execution(defaults) == defaults
    assert ignored_fields("lerobot", {"checkpoint": str(tmp_path)}) == ()


def changed(act: Path, tmp_path: Path, **fields: Any) -> Path:
    folder = copied(act, tmp_path)
    config = json.loads((folder / CONFIG_FILE).read_text())
    (folder / CONFIG_FILE).write_text(json.dumps({**config, **fields}))
    return folder


VALUES = {
    "temporal_ensemble_coeff": 0.01,
    "rtc_config": {"enabled": True, "execution_horizon": 7},
    "rtc_ramp_rate": 2.5,
    "per_episode_seed": True,
    "eval_seed": 17,
    "compile_model": True,
}


@pytest.mark.parametrize("name", [name for name, row in EXECUTION_FIELDS.items() if row.translated is None])
def test_what_is_ignored_is_named_with_its_value_and_does_not_reach_the_policy(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / CONFIG_FILE).write_text(json.dumps({"type": "act", name: VALUES[name]}))
    (tmp_path / "model.safetensors").touch()

    (line,) = ignored_fields("lerobot", {"checkpoint": str(tmp_path)})

    assert f"{tmp_path / CONFIG_FILE}: {name} = {VALUES[name]!r} is ignored: " in line and line.endswith(".")
    assert without_execution({name: VALUES[name], "x": 1}) == {name: EXECUTION_FIELDS[name].off, "x": 1}


class TestACheckpointMadeForTemporalEnsembling:
    def evaluation(self, folder: Path, **settings: Any) -> list[str]:
        config = EvalConfig(
            name="e", tasks=("RememberColor3-v0",), policies=(str(folder),), simulator="fake", **settings
        )
        return make_plan(config).warnings

    def test_eval_check_and_serve_say_it_once_and_its_actions_are_those_of_its_weights(
        self,
        act: Path,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        folder = changed(act, tmp_path, temporal_ensemble_coeff=0.02, n_action_steps=1)
        monkeypatch.setattr("vla_eval.serving.server.run_server", lambda *_args, **_kwargs: None)
        monkeypatch.setattr("vla_eval.cli.serve.WORKER_ENVIRONMENT", {})  # of this process

        (warning,) = self.evaluation(folder, n_action_steps=(1, 2))
        assert "temporal_ensemble_coeff = 0.02 is ignored" in warning
        assert "--n-action-steps 1 --set chunking.mode=temporal_ensemble" in warning
        assert "chunking.ensemble_decay=0.02." in warning
        assert host_policy(HostOptions(policy=str(folder))).ignored == (warning,)
        for command in (["check", str(folder)], ["serve", "--policy", str(folder)]):
            assert main(command) == 0
            assert capsys.readouterr().err.count(f"warning: {warning}\n") == 1
        assert load_checkpoint(folder, LoadOptions(device="cpu")).config.temporal_ensemble_coeff is None

    def test_nothing_is_said_where_the_evaluation_does_the_same(self, act: Path, tmp_path: Path) -> None:
        folder = changed(act, tmp_path, temporal_ensemble_coeff=0.02, n_action_steps=1)
        same = ChunkingSettings(mode="temporal_ensemble", ensemble_decay=0.02)
        other = ChunkingSettings(mode="temporal_ensemble", ensemble_decay=0.01)

        assert self.evaluation(folder, n_action_steps=(1,), chunking=same) == []
        assert len(self.evaluation(folder, n_action_steps=(2,), chunking=same)) == 1
        assert len(self.evaluation(folder, n_action_steps=(1,), chunking=other)) == 1

    def test_its_number_of_steps_is_the_default_of_the_evaluation(
        self, act: Path, tmp_path: Path, env: EnvSpec
    ) -> None:
        folder = changed(act, tmp_path, n_action_steps=3)
        config = EvalConfig(name="e", tasks=("RememberColor3-v0",), policies=(str(folder),), simulator="fake")

        assert {job.group.key.n_action_steps for job in make_plan(config).jobs} == {3}
        policy = make_lerobot(context_for(env), checkpoint=str(folder))
        assert policy.spec.chunk_size == act_config().chunk_size
