"""Family ids: tasks without a row, for which arguments say which task it is."""

import math
from pathlib import Path

import pytest

from tests.evaluation.resolved import make_plan
from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.config.evaluation import EvalConfig
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import TaskArgumentError, UnknownNameError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_cue_blind, make_oracle
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.storage.run_folder import read_run
from vla_eval.strict.decoding import decode
from vla_eval.tasks.catalog import FAMILIES, TASKS, find_task, task_spec
from vla_eval.tasks.spec import chance_of_several, total_cue_steps


def rows_of(family: str) -> list[str]:
    entry = FAMILIES[family].entry_point
    return [row.id for row in TASKS.values() if row.id.startswith(family) and row.entry_point == entry]


def longest_wait(task: str) -> int:
    """Cue and delay of a row with its defaults, from the task table of the paper."""
    n_shown = TASKS[task].kwargs.get("n_shown", 1)
    if task.startswith(("SeqOfColors", "ChainOfColors")):
        return 5 * n_shown + 5
    if task.startswith("ShellGame"):
        return 5
    return 10 if TASKS[task].candidates else 0


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_family_with_the_arguments_of_a_row_has_the_row_s_horizon(family: str) -> None:
    for row in rows_of(family):
        assert FAMILIES[family].default_horizon_steps(longest_wait(row)) == TASKS[row].horizon_steps


def test_a_family_grows_with_its_delay_and_a_row_does_not() -> None:
    # 5 steps of cue, 900 of delay, and the 50 for the response that 60 - 5 - 5 leaves.
    assert task_spec("RememberColor").default_horizon_steps(905) == 955
    assert task_spec("RememberColor3-v0").default_horizon_steps(905) == 60


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_family_leaves_open_just_what_tells_its_rows_apart(family: str) -> None:
    rows = [TASKS[row].kwargs for row in rows_of(family)]
    differing = {name for row in rows for name in row if row[name] != rows[0][name]}
    assert set(FAMILIES[family].open_arguments) == differing
    assert find_task(family) is FAMILIES[family]


def config(**fields: object) -> EvalConfig:
    data = {"name": "x", "tasks": ["RememberColor"], "policies": ["hold"], **fields}
    return decode(EvalConfig, data, where="test")


def test_a_family_without_its_arguments_is_refused_before_anything_starts() -> None:
    with pytest.raises(
        TaskArgumentError, match=r"--set env\.n_items=….*RememberColor3-v0, RememberColor5-v0"
    ):
        make_plan(config())
    assert make_plan(config(env={"n_items": 4})).task_versions == {"RememberColor": 1}


def test_a_final_choice_where_there_is_none_to_make_is_refused_before_anything_starts() -> None:
    strict = {"strict_choice": True}
    with pytest.raises(TaskArgumentError, match="InterceptMedium-v0: there are no candidates"):
        make_plan(config(tasks=["RememberColor3-v0", "InterceptMedium-v0"], env=strict))
    assert make_plan(config(tasks=["RememberColor3-v0"], env=strict)).jobs


def test_an_environment_of_a_family_without_its_arguments_is_refused() -> None:
    with pytest.raises(TaskArgumentError, match="n_shown must say which one"):
        make_env(EnvSettings(task="SeqOfColors", simulator="fake"))


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (
            {"delay_steps": 10**12},
            r"delay_steps=1000000000000: expected a whole number of control steps, 0 to 10000",
        ),
        ({"delay_steps": True}, "delay_steps=True: expected a whole number"),
        ({"cue_steps": "5"}, "cue_steps='5': expected a whole number"),
        ({"cue_steps": [1, None]}, r"cue_steps=\[1, None\]: expected a whole number"),
        ({"horizon_steps": 0}, "horizon_steps=0: expected 1 to 10000"),
    ],
)
def test_a_duration_that_is_none_is_refused_before_anything_starts(
    env: dict[str, object], message: str
) -> None:
    with pytest.raises(TaskArgumentError, match=message):
        make_plan(config(tasks=["RememberColor3-v0"], env=env))


@pytest.mark.parametrize(
    ("task", "env", "message"),
    [
        ("RememberColor", {"n_items": "x"}, "'n_items': expected a whole number, found 'x'"),
        ("RememberColor", {"n_items": 10**12}, "n_items=1000000000000: expected 2 to 9"),
        ("InterceptMedium-v0", {"velocity_range_m_s": 3}, "'velocity_range_m_s': expected a list"),
        ("InterceptMedium-v0", {"velocity_range_m_s": [1, 0]}, r"expected \(least, most\)"),
    ],
)
def test_the_fake_environment_refuses_what_no_task_could_be(
    task: str, env: dict[str, object], message: str
) -> None:
    with pytest.raises(TaskArgumentError, match=message):
        make_env(EnvSettings(task=task, kwargs=env, simulator="fake"))


def test_a_mistyped_family_gets_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'ChainOfColors'"):
        task_spec("ChainOfColor")


def test_a_run_of_a_family_records_task_arguments_and_chance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(
        [
            *("eval", "--task", "RememberColor", "--policy", "hold", "--episodes", "2", "--workers", "1"),
            *("--set", "env.n_items=4", "--set", "env.delay_steps=100", "--set", "simulator=fake"),
            *("--out", str(tmp_path / "run")),
        ]
    )

    run = read_run(tmp_path / "run")
    assert code == 0
    assert run.description.config["env"] == {"n_items": 4, "delay_steps": 100}
    # 5 + 100 + 50 steps: see above.
    assert [(r.task, r.n_steps, r.chance_success) for r in run.records] == [("RememberColor", 155, 0.25)] * 2
    assert "RememberColor" in capsys.readouterr().out


def test_every_row_belongs_to_one_family() -> None:
    members = [row for family in FAMILIES for row in rows_of(family)]
    assert sorted(members) == sorted(TASKS)


def test_families_are_listed_and_explained(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "families"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(FAMILIES)
    assert main(["show", "SeqOfColors"]) == 0
    out = capsys.readouterr().out
    assert "n_shown = … (must be given)" in out
    assert "at least 80 steps after cue and delay" in out
    assert "cue n_shown × 5 steps" in out


@pytest.mark.parametrize(
    ("n_items", "n_shown", "in_order", "expected"),
    # By hand: 9·8·7 / 3! = 84 sets of three of nine, 9·8·7 = 504 sequences; of two, one pair, two orders.
    [
        (9, 3, False, 1 / 84),
        (9, 3, True, 1 / 504),
        (2, 2, False, 1),
        (2, 2, True, 1 / 2),
        (5, 1, True, 1 / 5),
    ],
)
def test_chance_of_several(n_items: int, n_shown: int, in_order: bool, expected: float) -> None:
    assert math.isclose(chance_of_several(n_items, n_shown, in_order=in_order), expected)


def test_a_cue_in_turn_lasts_for_all_items_and_the_gaps_between_them() -> None:
    assert total_cue_steps(5, 7, 0) == 35
    assert total_cue_steps(5, 3, 2) == 5 + 2 + 5 + 2 + 5
    assert total_cue_steps(5, 1, 2) == 5


def play_fake(task: str, make: object, seeds: range) -> list[bool]:
    env = make_env(EnvSettings(task=task, simulator="fake", privileged=True))
    chunking = ChunkingSpec(n_action_steps=1)
    policy = make(PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=9))  # type: ignore[operator]
    outcomes = []
    for seed in seeds:
        start = EpisodeStart(
            slot=0, task=task, seed=seed, run=0, instruction="go", horizon_steps=env.spec.horizon_steps
        )
        (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
        outcomes.append(bool(record.success_once))
        assert record.n_candidates == 9
        assert record.target is None
    return outcomes


@pytest.mark.parametrize("task", ["BunchOfColors3-v0", "ChainOfColors3-v0"])
def test_the_fake_simulator_plays_several_targets(task: str) -> None:
    assert all(play_fake(task, make_oracle, range(1, 6)))
    assert not any(play_fake(task, make_cue_blind, range(1, 6)))  # 1/84, 1/504
