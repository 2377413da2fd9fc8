"""A table of learned policies: what it takes, what is missing of it, and all of it with tiny models."""

import argparse
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import build_parser, main
from vla_eval.cli.shared.model_table import EVAL_FLAGS, FINETUNE_FLAGS
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import load_recipe
from vla_eval.config.finetuning import FinetuneConfig, merge_fields
from vla_eval.config.policy import PolicyRecipe
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import FolderInUseError, VlaEvalError
from vla_eval.evaluation.model_table import (
    describe_effort,
    evaluations,
    finetunings,
    gpu_hours,
    is_model_table,
    load_model_table,
    narrow,
)
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.results.published.literature import paper_figures
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.tasks.catalog import task_spec
from vla_eval.training.finetune import FinetuneSummary

PAPER = "paper_vla_table"
TASK = "RememberColor3-v0"
ROW = {"name": "one", "policy": "act", "n_action_steps": [4]}
DRY_RUN = ("dry_run", "device_memory", "tflops")
USED = {
    "eval": {
        "dry_run",
        "out",
        "workers",
        "shard",
        "cluster",
        "json_progress",
        "allow_environment_change",
        "format",
        "baseline",
        "paper",
        "published",
        "preset",
        "wide",
        "tiny",
        "html",
        "help",
        "tasks",
        "policies",
    },
    "finetune": {"out", "device", "cluster", "allow_unreplayed", "help", "tasks", "policy", *DRY_RUN},
}


@pytest.fixture(autouse=True)
def cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Return the paper's table for one task and one training run."""
    data = yaml.safe_load(Path("configs/paper_vla_table.yaml").read_text(encoding="utf-8"))
    data |= {"name": "small", "tasks": [TASK], "run_seeds": [0], "datasets": str(tmp_path / "data")}
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def changed(small: Path, **changes: Any) -> Path:
    path = small.with_name("changed.yaml")
    path.write_text(yaml.safe_dump(yaml.safe_load(small.read_text()) | changes), encoding="utf-8")
    return path


def test_the_papers_table_is_five_rows_on_five_tasks_in_three_runs() -> None:
    table = load_model_table(PAPER)
    assert {row.n_action_steps for row in table.rows} == {(4,), (8,)} and len(table.rows) == 5
    assert set(table.tasks) == {figure.task for figure in paper_figures()}
    every = finetunings(table, Path("out"))
    assert len(every) == 5 * 5 * 3 and len({one.config.out for one in every}) == 75
    assert all(one.config.finetune["steps"] == 50_000 for one in every)
    assert (table.episodes, table.seed_start) == (100, 1)


def test_each_row_executes_no_more_than_the_chunk_that_its_policy_is_trained_for() -> None:
    for row in load_model_table(PAPER).rows:
        recipe = load_recipe("policies", row.policy, PolicyRecipe).value.finetune
        assert recipe is not None
        trained = merge_fields(recipe.policy, (row.finetune or {}).get("policy", {}))
        assert trained["chunk_size"] == row.n_action_steps[0], row.name


def test_chance_and_ceiling_are_measured_at_the_number_of_action_steps_of_each_row(tmp_path: Path) -> None:
    configs = dict(evaluations(load_model_table(PAPER), tmp_path))
    assert len(configs) == 5 * (2 + 5 * 3)  # a task: controls at K = 4 and 8, five rows in three runs
    for steps in (4, 8):
        controls = configs[tmp_path / "evaluation" / f"{TASK}-controls-k{steps}"]
        assert controls.n_action_steps == (steps,) and controls.tasks == (TASK,)
        assert set(controls.policies) == {"random", "cue_blind", "oracle"}
    one = configs[tmp_path / "evaluation" / f"{TASK}-octo_small-run-2"]
    assert one.tasks == (TASK,) and one.n_action_steps == (4,) and len(one.policies) == 1
    recipe = yaml.safe_load(Path(one.policies[0]).read_text())
    assert recipe["args"]["checkpoint"] == str(tmp_path / "training" / "octo_small" / TASK / "run-2")
    assert recipe["default_n_action_steps"] == 4


def test_rows_may_have_several_numbers_of_action_steps_tasks_and_fields_of_their_own(
    small: Path, tmp_path: Path
) -> None:
    other = "InterceptMedium-v0"
    free = {"policy": {"free_translation": True}}
    rows: list[dict[str, Any]] = [
        {"name": "still", "policy": "memory", "n_action_steps": [1, 4, 8], "tasks": [TASK]},
        {
            "name": "moving",
            "policy": "memory",
            "n_action_steps": [1, 4, 8],
            "tasks": [other],
            "finetune": free,
        },
        {"name": "plain", "policy": "act", "n_action_steps": [4], "slots_per_worker": 8},
    ]
    fields = {"policy": {"heads": 4}, "num_workers": 0}
    settings = {"render": {"wrist_mesh": "simplified"}, "stop_at_success": True}
    changes = {"rows": rows, "tasks": [TASK, other], "steps": None, "finetune": fields, **settings}
    table = load_model_table(str(changed(small, **changes)))
    every = {(one.row.name, one.task): one.config.finetune for one in finetunings(table, tmp_path)}
    assert every == {
        ("still", TASK): fields,
        ("moving", other): {"policy": {"heads": 4, "free_translation": True}, "num_workers": 0},
        ("plain", TASK): fields,
        ("plain", other): fields,
    }
    told = [
        (folder.name, config.n_action_steps, [Path(policy).stem for policy in config.policies])
        for folder, config in evaluations(table, tmp_path)
    ]
    controls = [(k, (k,), ["random", "cue_blind", "oracle"]) for k in (1, 4, 8)]
    assert told == [
        *((f"{TASK}-controls-k{k}", *rest) for k, *rest in controls),
        (f"{TASK}-still-run-0", (1, 4, 8), ["still"]),
        (f"{TASK}-plain-run-0", (4,), ["plain"]),
        *((f"{other}-controls-k{k}", *rest) for k, *rest in controls),
        (f"{other}-moving-run-0", (1, 4, 8), ["moving"]),
        (f"{other}-plain-run-0", (4,), ["plain"]),
    ]
    for _, config in evaluations(table, tmp_path):
        assert config.stop_at_success and config.render.wrist_mesh == "simplified"
        assert config.slots_per_worker == (8 if "plain" in config.name else 1)
    assert "4 fine-tunings" in describe_effort(table, n_finished=0)
    assert "GPU hours" not in describe_effort(table, n_finished=0)  # nobody said what they cost


def test_a_part_of_a_table_lies_where_the_whole_has_it(tmp_path: Path) -> None:
    """So a table is evaluated row by row, while the others are still trained, and is whole in the end."""
    table = load_model_table("memory_table")
    parts = [
        narrow(table, rows=["memory", "memoryless"]),
        narrow(table, rows=["memory_free", "memoryless_free"]),
        narrow(table, tasks=["RememberColor9-v0", "ShellGameTouch-v0"], rows=["diffusion"]),
        narrow(table, tasks=["RememberColor3-v0", "RememberColor5-v0"], rows=["diffusion"]),
        narrow(table, tasks=["InterceptMedium-v0"], rows=["diffusion"]),
    ]
    whole = dict(evaluations(table, tmp_path))
    found: dict[Path, Any] = {}
    for part in parts:
        for folder, config in evaluations(part, tmp_path):
            assert config == whole[folder]
            found[folder] = config
    assert found == whole
    trained = [str(one.config.out) for part in parts for one in finetunings(part, tmp_path)]
    assert sorted(trained) == sorted(str(one.config.out) for one in finetunings(table, tmp_path))
    assert narrow(table) == table


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"tasks": ["RememberColour9-v0"]}, "Did you mean 'RememberColor9-v0'"),
        ({"rows": ["memoryles"]}, "Did you mean 'memoryless'"),
        ({"tasks": ["InterceptMedium-v0"], "rows": ["memory"]}, "none of the rows memory is for"),
    ],
)
def test_a_part_that_the_table_has_not_is_refused(part: dict[str, list[str]], message: str) -> None:
    with pytest.raises(VlaEvalError, match=message):
        narrow(load_model_table("memory_table"), **part)


def test_a_task_that_no_row_is_for_is_said_so(small: Path) -> None:
    rows = [{"name": "other", "policy": "act", "n_action_steps": [4], "tasks": [TASK]}]
    table = load_model_table(str(changed(small, rows=rows, tasks=[TASK, "InterceptMedium-v0"])))
    with pytest.raises(VlaEvalError, match="no row is for InterceptMedium-v0"):
        narrow(table, tasks=["InterceptMedium-v0"])


def test_gpu_hours_count_the_passes_that_training_needs() -> None:
    """π0, all weights, batch 32: 6 · 3.3e9 · 570 · 32 · 50,000 operations at 1e14 per second."""
    rows = {row.name: row for row in load_model_table(PAPER).rows}
    assert gpu_hours(rows["pi0"], steps=50_000) == pytest.approx(50.16, rel=1e-3)


def test_a_table_is_told_from_an_evaluation() -> None:
    assert is_model_table(PAPER) and not is_model_table("demo")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"run_seeds": [0, 0]}, "run_seeds"),
        ({"tasks": []}, "tasks"),
        ({"steps": 0}, "steps"),
        ({"controls": ["pi0"]}, "share a name"),
        ({"tasks": ["RememberColour3-v0"]}, "Did you mean"),
        ({"rows": [{**ROW, "n_action_steps": []}]}, "expected numbers ≥ 1"),
        ({"rows": [{**ROW, "n_action_steps": [4, 4]}]}, "none of them twice"),
        ({"rows": [{**ROW, "slots_per_worker": 0}]}, "slots_per_worker is 0, expected a number ≥ 1"),
        ({"rows": [{**ROW, "tasks": ["RememberColor5-v0"]}]}, f"Did you mean '{TASK}'"),
        ({"rows": [{**ROW, "cost": {"parameters": 0, "tokens": 1, "trained": "all"}}]}, "parameters is 0"),
    ],
)
def test_what_makes_no_table_is_refused(small: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(VlaEvalError, match=message):
        load_model_table(str(changed(small, **changes)))


def test_a_missing_dataset_is_found_before_the_first_training(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["finetune", str(small), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "5 fine-tunings" in told and "GPU hours" in told and "mikasa-vla record" in told


def test_processes_share_a_table_and_leave_each_other_alone(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data" / TASK).mkdir(parents=True)
    out = tmp_path / "out"
    rows = [{**ROW, "name": name} for name in ("first", "second", "third", "fourth")]
    begun: list[str] = []

    def train(config: FinetuneConfig, **_: Any) -> FinetuneSummary:
        folder = Path(str(config.out))
        name = folder.relative_to(out / "training").parts[0]
        begun.append(name)
        if name == "second":
            raise FolderInUseError(f"{folder}: another process")
        monkeypatch.setattr(  # the other process comes to an end with the third meanwhile
            "vla_eval.studies.study.is_finished", lambda one: one.row.name in (*begun, "third")
        )
        return FinetuneSummary(out=folder, step=5, is_finished=True)

    monkeypatch.setattr("vla_eval.training.finetune.finetune", train)
    path = changed(small, rows=rows, steps=5, finetune={"save_every_steps": 5})
    assert main(["finetune", str(path), "--out", str(out)]) == 0
    assert begun == ["first", "second", "fourth"]
    said = capsys.readouterr().err
    assert "second on RememberColor3-v0, run seed 0\n  another process is training it" in said


def test_a_signal_stops_a_table_and_the_rows_that_follow_are_not_begun(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data" / TASK).mkdir(parents=True)
    begun: list[str] = []

    def train(config: FinetuneConfig, *, is_stopping: Callable[[], bool], **_: Any) -> FinetuneSummary:
        begun.append(str(config.out))
        signal.raise_signal(signal.SIGTERM)
        return FinetuneSummary(out=Path(str(config.out)), step=3, is_finished=not is_stopping())

    monkeypatch.setattr("vla_eval.training.finetune.finetune", train)
    path = changed(small, rows=[ROW, {**ROW, "name": "two"}], steps=5, finetune={"save_every_steps": 5})
    assert main(["finetune", str(path), "--out", str(tmp_path / "out")]) == 143
    assert len(begun) == 1
    screen = capfd.readouterr()
    assert screen.out == ""
    assert f"[1/2] one on {TASK}, run seed 0: stopped at step 3. To resume: " in screen.err


def test_an_evaluation_says_what_has_not_been_trained(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(small), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "octo_small on RememberColor3-v0, run seed 0" in told and "2 more" in told
    assert f"mikasa-vla finetune {small} --out" in told
    flags = ["--task", TASK, "--policy", "pi0", "spatialvla"]
    assert main(["eval", str(small), *flags, "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "octo_small" not in told and "more" not in told
    assert f"mikasa-vla finetune {small} {' '.join(flags)} --out" in told


def test_a_part_of_a_table_is_for_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = ["finetune", "--dataset", str(tmp_path), "--policy", "act"]
    assert main([*alone, "--task", TASK]) == 1
    assert "--task is for a table" in capsys.readouterr().err
    assert main([*alone, "memory"]) == 1
    assert "expected one name" in capsys.readouterr().err


def test_flags_that_a_table_sets_itself_are_refused(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(small), "--episodes", "3"]) == 1
    assert "--episodes" in capsys.readouterr().err
    assert main(["eval", "demo", "--tiny"]) == 1
    assert "--tiny" in capsys.readouterr().err


@pytest.mark.parametrize(
    "flags",
    [
        ("eval", "--episodes", "3"),
        ("eval", "--seed-start", "0"),
        ("eval", "--set", "runs=2"),
        ("eval", "--serve"),
        ("finetune", "--run-seed", "0"),
        ("finetune", "--held-out-episodes", "3"),
        ("finetune", "--set", "batch_size=2"),
    ],
)
def test_no_flag_is_passed_over(
    small: Path, tmp_path: Path, flags: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, flag, *value = flags
    assert main([verb, str(small), flag, *value, "--out", str(tmp_path / "out")]) == 1
    assert f"{flag}: a table of learned policies sets this itself" in capsys.readouterr().err


def test_a_dry_run_says_what_is_left_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["eval", "memory_table", "--policy", "diffusion", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "5 fine-tunings (1 rows, 5 tasks, 1 run seeds), 0 of them finished" in said
    assert main(["eval", "paper_vla_table", "--tiny", "--dry-run"]) == 1
    assert "leave out --dry-run" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("verb", "refused"), [("eval", EVAL_FLAGS), ("finetune", FINETUNE_FLAGS)])
def test_a_flag_is_refused_or_used(verb: str, refused: tuple[str, ...]) -> None:
    (choices,) = [
        a.choices for a in build_parser((verb,))._actions if isinstance(a, argparse._SubParsersAction)
    ]
    flags: dict[str, list[str]] = {}
    for action in choices[verb]._actions:
        if action.option_strings:  # an old name of a flag has an action of its own
            flags[action.dest] = [*flags.get(action.dest, []), *action.option_strings]
    words = {name: "--set" if name == "overrides" else f"--{name.replace('_', '-')}" for name in refused}
    assert all(flag in flags[name] for name, flag in words.items())
    assert flags.keys() - words.keys() - {"no_lock"} == USED[verb]  # main's own, for every verb


@pytest.mark.parametrize("task", load_model_table(PAPER).tasks)
def test_demonstrations_of_every_task_of_the_table_can_be_recorded_on_the_stand_in(task: str) -> None:
    env = make_env(EnvSettings(task=task, simulator="fake", privileged=True))
    chunking = ChunkingSpec(n_action_steps=1)
    n_candidates = 0 if task_spec(task).candidates is None else 9
    context = PolicyContext(name="oracle", env=env.spec, chunking=chunking, n_candidates=n_candidates)
    start = EpisodeStart(
        slot=0, task=task, seed=1000, run=0, instruction="go", horizon_steps=env.spec.horizon_steps
    )
    (record,) = rollout(env, make_oracle(context), [start], RolloutSettings(chunking=chunking))
    assert record.success_once
