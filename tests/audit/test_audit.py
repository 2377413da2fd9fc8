"""The audit's verdicts, from counts; and the command, on the fake simulator."""

import json
from pathlib import Path

import pytest

from vla_eval.audit.audit_text import render_audit
from vla_eval.audit.evaluations import CONTROLS, audit_configs, audit_task, kind_of, verdict
from vla_eval.cli.main import main
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.records import EpisodeRecord
from vla_eval.results.shipped_audit import Counts
from vla_eval.tasks.catalog import TASKS, task_spec

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
    families = {"ball": "Intercept", "no_choice": ("Rotate", "TakeItBack")}
    for kind, names in families.items():
        assert {task for task in TASKS if kinds[task] == kind} == {
            task for task in TASKS if task.startswith(names)
        }
    paper = audit_configs(list(TASKS), ("paper",), episodes=3, workers=1)
    assert sorted(task for config in paper for task in config.tasks) == sorted(TASKS)
    strict = audit_configs(list(TASKS), ("strict",), episodes=3, workers=1)
    assert {kind_of(task_spec(task)) for config in strict for task in config.tasks} == {"choice", "several"}
    assert all(config.env["freeze_until_choice"] and config.env["strict_choice"] for config in strict)


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
