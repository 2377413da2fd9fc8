"""The audit's verdicts, from counts; and the command, on the fake simulator."""

import json
from pathlib import Path

import pytest

from vla_eval.audit.audit_text import render_audit
from vla_eval.audit.evaluations import CONTROLS, audit_configs, audit_task, kind_of, protocols_of
from vla_eval.audit.verdicts import verdict
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.records import EpisodeRecord
from vla_eval.results.shipped_audit import Counts
from vla_eval.tasks.catalog import SUITES, TASKS, task_spec

FAKE = ["--set", "simulator=fake", "--workers", "1"]


def counts(**successes: int) -> dict[str, Counts]:
    """Controls that succeeded so often in 30 episodes with a chance of 1/3."""
    return {
        control: Counts(n_episodes=30, success_once=n, success_at_end=n, first_choice=n, chance=1 / 3)
        for control, n in successes.items()
    }


BLIND_AS_CHANCE = {"random": 0, "hold": 0, "oracle": 30, "cue_blind": 10}


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ({}, ("needs memory",)),
        ({"tour": 30}, ("can be toured",)),
        # Binomial(30, 1/3): P(X >= 18) = 2.5e-3 and P(X >= 19) = 7.2e-4; the level is 1e-3.
        ({"tour": 18}, ("needs memory",)),
        ({"tour": 19}, ("can be toured",)),
        ({"tour": 30, "body_memory": 30}, ("can be toured", "body can store the cue")),
        ({"cue_touch": 30}, ("won by staying at the cue",)),
        ({"hold": 1}, ("won without acting",)),
        ({"cue_blind": 29}, ("won without the cue",)),
        # No shortcut, but an oracle that is no better than a blind arm shows nothing.
        ({"oracle": 12}, ("not decided",)),
    ],
)
def test_a_verdict_names_the_roads_that_beat_chance(found: dict[str, int], expected: tuple[str, ...]) -> None:
    assert verdict(counts(**{**BLIND_AS_CHANCE, **found}), 1 / 3) == expected


def test_where_chance_is_measured_the_blind_arm_is_what_the_oracle_is_compared_with() -> None:
    assert verdict(counts(hold=0, random=0, oracle=29, cue_blind=4), None) == ("needs memory",)
    assert verdict(counts(hold=0, random=0, oracle=5, cue_blind=4), None) == ("not decided",)


def test_a_ball_that_single_frames_catch_needs_no_memory() -> None:
    """The blind arm is what the control is compared with; Fisher, 4 of 30: 15 has p = 2.5e-3, 17 has 5e-4."""
    met = {"hold": 0, "random": 0, "oracle": 30, "cue_blind": 4}
    assert verdict(counts(**met, one_frame=17), None) == ("won from single frames",)
    assert verdict(counts(**met, one_frame=15), None) == ("needs memory",)


def test_every_task_is_played_by_the_controls_that_fit_it() -> None:
    kinds = {task: kind_of(spec) for task, spec in TASKS.items()}
    assert sum(kind == "several" for kind in kinds.values()) == 9  # Bunch, Seq, Chain of 3, 5, 7
    families = {"ball": "Intercept", "cube": "TakeItBack", "no_choice": "Rotate"}
    for kind, names in families.items():
        assert {task for task in TASKS if kinds[task] == kind} == {
            task for task in TASKS if task.startswith(names)
        }
    paper = audit_configs(list(TASKS), ("paper",), episodes=3, workers=1)
    assert sorted(task for config in paper for task in config.tasks) == sorted(TASKS)
    strict = audit_configs(list(TASKS), ("strict",), episodes=3, workers=1)
    assert {kind_of(task_spec(task)) for config in strict for task in config.tasks} == {"choice", "several"}
    assert all(config.env["freeze_until_choice"] and config.env["strict_choice"] for config in strict)


def test_the_official_tasks_are_played_by_the_controls_that_fit_them() -> None:
    tasks = list(SUITES["mikasa_vla_90"])
    assert protocols_of(tasks, ("paper", "strict")) == ("official",)
    configs = {c.name: c for c in audit_configs(tasks, ("official",), episodes=3, workers=1)}
    n_tasks = {name.removeprefix("audit_official_"): len(config.tasks) for name, config in configs.items()}
    # Remember-Long; other choices: the arm waits, or mugs move; balls; pegs and TakeItBack; the rest.
    assert n_tasks == {"choice": 9, "search": 25, "ball": 6, "no_choice": 5, "unscripted": 45}
    assert configs["audit_official_unscripted"].policies == ("random", "hold")
    assert {(config.seed_start, config.stop_at_success) for config in configs.values()} == {
        (4242424242, True)
    }


def test_only_the_controls_that_are_named_are_run() -> None:
    tasks = ["mikasa_vla/RememberColor3-VLA-v0", "mikasa_vla/TimedTransferEasy-VLA-v0"]
    settings = {"episodes": 1, "workers": 1}
    (config,) = audit_configs(tasks, ("official",), controls=["tour"], **settings)  # type: ignore[arg-type]
    assert (config.tasks, config.policies) == ((tasks[0],), ("tour",))
    with pytest.raises(RecipeError, match="--control tour: none of these fits mikasa_vla/TimedTransferEasy"):
        audit_configs(tasks[1:], ("official",), controls=["tour"], **settings)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match=r"no control 'tuor'.*Did you mean 'tour'"):
        audit_configs(tasks, ("official",), controls=["tuor"], **settings)  # type: ignore[arg-type]


def test_official_tasks_and_ours_are_not_audited_in_one_run() -> None:
    tasks = ["RememberColor3-v0", "mikasa_vla/RememberColor3-VLA-v0"]
    with pytest.raises(RecipeError, match="RememberColor3-v0: audited under other protocols"):
        protocols_of(tasks, ("paper",))


def test_the_mug_of_official_tasks_may_be_set() -> None:
    tasks = ["mikasa_vla/ShellGameTouch-VLA-v0"]
    settings = {"env": {"mug": "stand_in"}}
    (config,) = audit_configs(tasks, ("official",), episodes=1, workers=1, settings=settings)
    assert config.env == {"mug": "stand_in"}


def test_a_task_without_a_scripted_arm_is_not_audited() -> None:
    assert verdict(counts(hold=0), None, scripted=False) == ("not audited: no scripted control",)
    won = ("won without acting", "not audited: no scripted control")
    assert verdict(counts(hold=1), None, scripted=False) == won


def test_a_task_needs_memory_only_where_the_oracle_beats_every_control() -> None:
    # Fisher, 30 of 30: against 18 of 30 p = 8e-5; but not against 25 of 30, p = 0.03, at a chance of 0.7.
    assert verdict(counts(**{**BLIND_AS_CHANCE, "tour": 18}), 1 / 3) == ("needs memory",)
    assert verdict(counts(**{**BLIND_AS_CHANCE, "tour": 25}), 0.7) == ("not decided",)


def test_without_a_blind_arm_the_oracle_is_compared_with_chance() -> None:
    assert verdict(counts(hold=0, oracle=30, tour=10), 1 / 3) == ("needs memory",)
    assert verdict(counts(hold=0, oracle=12, tour=10), 1 / 3) == ("not decided",)
    assert verdict(counts(hold=0, tour=10), 1 / 3) == ("not decided",)


def test_mistakes_are_said_before_anything_is_played() -> None:
    with pytest.raises(UnknownNameError, match="RememberColor3-v0"):
        audit_configs(["RememberColour3-v0"], ("paper",), episodes=1, workers=1)
    with pytest.raises(RecipeError, match="no strict rule"):
        audit_configs(["TakeItBack-v0"], ("strict",), episodes=1, workers=1)
    with pytest.raises(RecipeError, match="--set env: an audit sets this field itself"):
        audit_configs(["TakeItBack-v0"], ("paper",), episodes=1, workers=1, settings={"env": {}})


def test_an_audit_does_not_depend_on_the_order_in_which_episodes_came_to_an_end() -> None:
    task = "RememberColor3-v0"
    records = [
        EpisodeRecord(
            task=task,
            policy=policy,
            n_action_steps=1,
            run=0,
            seed=seed,
            outcome="failure",
            success_once=False,
        )
        for policy in CONTROLS["choice"]
        for seed in (1, 2)
    ]
    one, other = (render_audit([audit_task(task, "paper", r)], "json") for r in (records, records[::-1]))
    assert one == other


@pytest.mark.usefixtures("in_this_process")
def test_the_command_plays_prints_and_goes_on_where_it_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["audit", "--task", "RememberColor3-v0", "InterceptMedium-v0", "--protocol", "paper"]
    arguments += ["--episodes", "2", *FAKE, "--out", str(tmp_path)]
    assert main(arguments) == 0
    (header, _, color, ball), *_ = [capsys.readouterr().out.splitlines()[:4]]
    assert all(control in header for control in CONTROLS["choice"])
    assert color.startswith("| RememberColor3-v0 | paper | 33.3 |")
    assert ball.startswith("| InterceptMedium-v0 | paper | measured |")
    assert color.count("| – ") == 1 and ball.count("| – ") == 3  # one_frame; tour, cue_touch, body_memory

    assert main([*arguments, "--format", "json"]) == 0
    shown = capsys.readouterr()
    assert "all 14 episodes are there" in shown.err  # 7 controls, 2 episodes each
    assert "all 10 episodes are there" in shown.err
    audited = json.loads(shown.out)
    assert [row["task"] for row in audited] == ["RememberColor3-v0", "InterceptMedium-v0"]
    oracle = audited[0]["counts"]["oracle"]
    assert (oracle["n_episodes"], oracle["success_once"], oracle["first_choice"]) == (2, 2, 2)


def test_the_command_audits_official_tasks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = [f"mikasa_vla/{name}-VLA-v0" for name in ("RememberColor3", "TimedTransferEasy")]
    arguments = ["audit", "--task", *tasks, "--control", "hold", "tour", "--episodes", "2", *FAKE]
    arguments += ["--set", "env.horizon_steps=30", "--out", str(tmp_path)]
    assert main(arguments) == 0
    color, timed = capsys.readouterr().out.splitlines()[2:4]
    assert color.startswith(f"| {tasks[0]} | official | 33.3 |")
    assert timed.startswith(f"| {tasks[1]} | official | – |")
    assert timed.endswith("| not audited: no scripted control |")
