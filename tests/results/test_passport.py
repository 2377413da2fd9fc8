"""Passports: how a figure was made, as far as that is known; what differs, and so is not ranked."""

import itertools
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import pytest

from tests.results.stored_runs import COLOR, INTERCEPT, episodes, has_note, stored
from vla_eval.config.evaluation import OPTION_FIELDS, EvalConfig
from vla_eval.config.files import to_data
from vla_eval.results.grouping import group_runs
from vla_eval.results.passport.fields import BY_NAME, FIELDS, SETTINGS, owner_of, setting_sections
from vla_eval.results.passport.passport import Passport, classes, differences
from vla_eval.results.report import build_table, render
from vla_eval.results.side_by_side.of_row import SUITES, passports_of
from vla_eval.seeding import SeedRange
from vla_eval.storage.run_file import leaves
from vla_eval.storage.run_folder import JsonValue, StoredRun
from vla_eval.tasks.spec import Suite

DOCS = Path(__file__).parents[2] / "docs"
SETTLED: dict[str, JsonValue] = {
    "task_versions": {COLOR: 1, INTERCEPT: 1},
    "env": {},
    "chunking": {"mode": "receding_horizon", "delay_steps": 0},
    "render": {"wrist_mesh": "shipped"},
    "simulator": "maniskill",
    "sim_backend": "cpu",
    "prompt_set": "paper",
    "stop_at_success": False,
}


def run_with(policy: str = "p", path: str = "runs/a", *, k: int = 1, **config: JsonValue) -> StoredRun:
    run = stored(episodes(policy, "++--", n_action_steps=k), path=path, **{**SETTLED, **config})
    recipes = {"prompts/paper": "a" * 64}
    return replace(run, description=replace(run.description, recipes=recipes))


def passport_of(run: StoredRun) -> Passport:
    (found,) = passports_of(group_runs([run])).values()
    return found


def changed(**config: JsonValue) -> list[str]:
    """Return the fields in which a run with these settings differs from one without them."""
    found = differences(passport_of(run_with()), passport_of(run_with(path="runs/b", **config)))
    return [one.field.name for one in found if one.is_known]


# ------------------------------------------------------------------------------- the table of fields


def test_every_setting_of_an_evaluation_belongs_to_one_field() -> None:
    defaults = to_data(EvalConfig(name="defaults", tasks=("any",), policies=("any",)))
    paths = [path for path, _ in leaves({name: defaults[name] for name in setting_sections()}, prefix="")]
    arguments = ["env.horizon_steps", "env.anything", "env", "chunking.delay.steps", "memory_change.kind"]
    assert all(owner_of(path, "setting") is not None for path in (*paths, *arguments))
    assert owner_of("env.horizon_steps", "setting") == BY_NAME["horizon"]
    assert owner_of("env.horizon_stepsize", "setting") == BY_NAME["world"]
    assert owner_of("chunking.delay_steps", "setting") == BY_NAME["delay"]
    assert owner_of("chunking.delay_alignment", "setting") == BY_NAME["execution"]
    assert owner_of("workers", "setting") is None


def test_a_new_field_of_an_evaluation_has_to_be_given_to_a_setting_or_to_those_that_are_none() -> None:
    episodes_alone = {"tasks", "policies", "n_action_steps", "episodes", "seed_start", "runs"}
    computed_alike = {"eager_rendering", "slots_per_worker", "inference", "inference_max_batch", "compile"}
    names = {one.name for one in fields(EvalConfig)} - set(OPTION_FIELDS)
    assert names - set(setting_sections()) == episodes_alone | computed_alike


def test_the_figures_of_each_effect_stand_on_the_page_it_names() -> None:
    for field in FIELDS:
        figures = re.findall(r"\d+\.\d+", field.effect)
        assert bool(figures) <= bool(field.page), field.name
        if field.page is not None:
            page = (DOCS / field.page).read_text(encoding="utf-8")
            assert [one for one in figures if one not in page] == [], field.name


@pytest.mark.parametrize(
    ("config", "field"),
    [
        ({"env": {"horizon_steps": 90}}, "horizon"),
        ({"env": {"image_size": 256}}, "image_size"),
        ({"env": {"control_mode": "pd_joint_pos"}}, "control_mode"),
        ({"env": {"robot_uids": "fetch_at_table"}}, "robot"),
        ({"env": {"robot": "fetch"}}, "robot"),
        ({"env": {"robot": "of a package that is not installed"}}, "robot"),
        ({"env": {"delay_steps": 5}}, "world"),
        ({"env": {"clutter": 4}}, "world"),
        ({"env": {"strict_choice": True}}, "success_rule"),
        ({"cue_view": "hidden"}, "world"),
        ({"chunking": {"mode": "receding_horizon", "delay_steps": 2}}, "delay"),
        ({"chunking": {"mode": "wait", "delay_steps": 0}}, "execution"),
        ({"sim_backend": "gpu"}, "simulator"),
        ({"render": {"wrist_mesh": "simplified"}}, "rendering"),
    ],
)
def test_a_setting_is_found_in_its_field_alone(config: dict[str, JsonValue], field: str) -> None:
    assert changed(**config) == [field]


def test_what_is_named_and_what_stands_without_being_named_are_the_same() -> None:
    named: JsonValue = {
        "control_mode": "pd_ee_delta_pose",
        "image_size": 128,
        "horizon_steps": 60,
        "robot": "panda_wristcam",
    }
    assert changed(env=named) == []
    table = build_table([run_with(), run_with("q", "runs/b", env=named)])
    assert {row.variant for row in table.rows} == {None}


def test_a_robot_is_the_same_by_its_name_and_by_maniskills() -> None:
    named, by_uid = (
        run_with(env={"robot": "fetch"}),
        run_with("q", "runs/b", env={"robot_uids": "fetch_at_table"}),
    )
    assert {row.variant for row in build_table([named, by_uid]).rows} == {None}
    light = run_with("q", "runs/b", env={"robot_uids": "panda_wristcam_light"})
    assert len({row.variant for row in build_table([run_with(), light]).rows}) == 2
    other = run_with("q", "runs/b", env={"robot_uids": "of_a_package_that_is_not_installed"})
    assert len({row.variant for row in build_table([named, other]).rows}) == 2


def test_episodes_that_stop_at_their_first_success_have_the_same_success_once() -> None:
    assert changed(stop_at_success=True) == []


def test_every_suite_has_words() -> None:
    assert set(SUITES) == set(get_args(Suite))


def test_the_usual_horizon_is_the_tasks_and_in_another_version_unknown() -> None:
    assert passport_of(run_with()).values["horizon"] == ("60 control steps",)
    other = passport_of(run_with(task_versions={COLOR: 99}))
    assert other.values["horizon"] == (None,)
    assert "unknown" in other.text("horizon")


def test_a_variant_names_the_usual_value_where_another_run_has_another_one() -> None:
    table = build_table([run_with(), run_with(path="runs/b", env={"horizon_steps": 90})])
    assert [row.variant for row in table.rows] == ["env.horizon_steps=60", "env.horizon_steps=90"]


def test_seeds_that_a_policy_was_trained_on_are_a_difference() -> None:
    clean, run = passport_of(run_with()), run_with(path="runs/b")
    seen = replace(run.description, training_seeds={"p": {COLOR: (SeedRange(first=3, last=9),)}})
    passport = passport_of(replace(run, description=seen))
    assert passport.values["seen_seeds"] == ("2 of 4 episodes",)  # seeds 3 and 4 of 1 to 4
    assert [one.field.name for one in differences(clean, passport) if one.is_known] == ["seen_seeds"]


# ------------------------------------------------------------------------------- unknown


def test_two_unknown_values_agree_only_within_one_origin() -> None:
    bare = stored(episodes("p", "+-"), episodes("q", "++"), path="runs/a")
    one, two = passports_of(group_runs([bare])).values()
    other = passport_of(stored(episodes("p", "+-"), path="runs/b"))
    assert one.standing == two.standing
    assert one.standing != other.standing
    unknown = [found.field.name for found in differences(one, other) if not found.is_known]
    assert "horizon" in unknown and "instructions" in unknown
    assert differences(one, one) == ()


def test_standing_is_an_equivalence_and_order_does_not_matter() -> None:
    """Generated: all pairs of values of three settings, known and not."""
    values = ((None,), ("1",), ("2",))
    found = [
        Passport(
            subject=f"{number}",
            origin=origin,
            values={one.name: ("x",) for one in FIELDS}
            | {"horizon": horizon, "n_action_steps": k, "image_size": size},
        )
        for number, (horizon, k, size, origin) in enumerate(
            itertools.product(values, values, values, ("a", "b"))
        )
    ]
    groups = classes(found)
    backwards = classes(found[::-1])
    assert {frozenset(one.subject for one in group) for group in groups} == {
        frozenset(one.subject for one in group) for group in backwards
    }
    for one, other in itertools.combinations(found, 2):
        known = all(one.known(name.name) and other.known(name.name) for name in SETTINGS)
        same = one.standing == other.standing
        assert same == (not [d for d in differences(one, other) if d.field.kind == "setting"])
        if known:
            assert same == (one.values == other.values)


# ------------------------------------------------------------------------------- what is not ranked


def test_two_rows_of_one_model_that_differ_in_k_and_horizon_are_not_ranked_and_why_is_said() -> None:
    runs = [
        run_with(k=4),
        run_with(path="runs/b", k=8, env={"horizon_steps": 90}),
    ]
    table = build_table(runs)
    first, second = table.passports.values()
    found = [one.field.name for one in differences(first, second)]
    assert [name for name in found if BY_NAME[name].kind == "setting"] == ["horizon", "n_action_steps"]
    assert has_note(table, "not ranked", COLOR, "horizon (60 control steps; 90 control steps) and K (4; 8)")
    assert has_note(table, "K: on RememberColor3", "docs/chunk_sizes.md")
    assert has_note(table, "horizon: a longer episode leaves more time")


def test_rows_of_the_same_settings_are_ranked_and_controls_make_no_note() -> None:
    assert not has_note(build_table([run_with(), run_with("q", "runs/b")]), "not ranked")
    controls = [run_with("oracle", k=1), run_with("oracle", "runs/b", k=4), run_with("p", "runs/c")]
    assert not has_note(build_table(controls), "not ranked")


def test_the_best_policy_in_latex_is_the_best_of_its_settings() -> None:
    n = 30
    good, bad, best = (
        stored(episodes(name, text, n_action_steps=k), path=f"runs/{name}", **SETTLED)
        for name, text, k in (("good", "+" * n, 4), ("bad", "-" * n, 4), ("best", "+" * n, 8))
    )
    prompts = {"prompts/paper": "a" * 64}
    runs = [replace(run, description=replace(run.description, recipes=prompts)) for run in (good, bad, best)]
    text = render(build_table(runs), "latex", preset="paper")
    lines = {line.partition(" &")[0]: line for line in text.splitlines() if line.endswith("\\\\")}
    assert "textbf" in lines["good, K = 4"]
    assert "textbf" not in lines["best, K = 8"]  # nothing was run beside it
    assert "are not ranked against each other" in text


def test_the_json_report_has_a_passport_of_each_row() -> None:
    table = build_table([run_with(k=4), run_with("q", "runs/b", k=8)])
    data = table.passports
    assert [key.policy for key in data] == ["p", "q"]
    assert '"passports"' in render(table, "json")
    assert all(set(one.to_dict()) == {field.name for field in FIELDS} for one in data.values())
