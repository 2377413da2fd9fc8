"""The command `probe` and its plan, on the fake simulator: the controls are part of every probe."""

import csv
import inspect
import io
import json
from pathlib import Path
from typing import Any

import pytest

from tests.evaluation.resolved import results_config
from vla_eval.cli.main import main
from vla_eval.config.environment import AppearanceSettings
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError
from vla_eval.probe.interventions import plan_probe
from vla_eval.probe.phases import CUE_STEPS, default_delay_steps, inferences, phases_of
from vla_eval.probe.worlds import ProbeSettings
from vla_eval.tasks.catalog import TASKS, task_spec
from vla_eval.tasks.memory_env import MemoryTableEnv
from vla_eval.tasks.register import env_class

pytestmark = pytest.mark.usefixtures("in_this_process")

FAKE = ["--set", "simulator=fake", "--workers", "1"]
N = 9
PLACE_MODULE = """
from vla_eval.core import ActionChunk
from vla_eval.oracles.hover import CUBES
from vla_eval.policies.controls.base import ScriptedPolicy, hold_rows

class OnePlace(ScriptedPolicy):
    privileged = True

    def act(self, window):
        state = self.privileged_state(window)
        if state.phase != "response":
            return ActionChunk(actions=hold_rows(state.gripper_width_m, self._n_actions))
        rightmost = int(state.candidate_positions_m[:, 1].argmin())
        return ActionChunk(actions=CUBES.plan(state, rightmost, self._n_actions))

def make(context):
    return OnePlace(context)
"""
REQUIRED = {
    *("task", "policy", "n_action_steps", "intervention", "level", "n_pairs", "sensitivity"),
    *("warranted_choice", "reliability", "success_once", "ci_low", "ci_high", "chance"),
}


@pytest.fixture
def one_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A policy that always goes to the rightmost place."""
    (tmp_path / "one_place_policy.py").write_text(PLACE_MODULE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    recipe = tmp_path / "one_place.yaml"
    recipe.write_text(json.dumps({"version": 1, "description": "d", "adapter": "one_place_policy:make"}))
    return str(recipe)


def probe(out: Path, capsys: pytest.CaptureFixture[str], *arguments: str, n: int = N) -> dict[str, Any]:
    command = ["probe", *arguments, *FAKE, "--episodes", str(n), "--out", str(out), "--format", "json"]
    assert main(command) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def rows_of(found: dict[str, Any], intervention: str) -> dict[str, dict[str, Any]]:
    return {row["policy"]: row for row in found["rows"] if row["intervention"] == intervention}


def test_controls_follow_the_swapped_cue_as_far_as_they_know_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], one_place: str
) -> None:
    short = ("--set", "env.horizon_steps=30")  # the choice begins at step 10
    arguments = ("--task", "RememberColor3-v0", "--policy", one_place, *short, "--probe", "swap")
    found = probe(tmp_path / "paper", capsys, *arguments, "interference")
    paper, moved = rows_of(found, "swap"), rows_of(found, "interference")
    assert {row["n_pairs"] for row in paper.values()} == {N}
    for policy in ("oracle", "body_memory"):
        assert (paper[policy]["n_warranted_choice"], paper[policy]["n_sensitivity"]) == (N, N)
        assert paper[policy]["reliability"] == 1.0
    for policy in ("one_place", "cue_blind"):
        assert (paper[policy]["n_warranted_choice"], paper[policy]["n_sensitivity"]) == (0, 0)
        assert paper[policy]["actions_changed"] == 0.0
        # One of three cues is followed by luck: in 18 episodes, 1 to 12 with a probability above 0.99.
        assert 0 < paper[policy]["matched_world_value"] <= 12 / 18
    assert paper["cue_blind"]["chance"] == pytest.approx(1 / 3)

    # The motion leaves the gripper open, which stands for the first of the candidates.
    assert moved["oracle"]["n_follows"] == N
    assert 0 < moved["body_memory"]["n_follows"] < N
    assert moved["body_memory"]["left"] == moved["body_memory"]["follows"]

    rule = ("--set", "env.freeze_until_choice=true", "--set", "env.strict_choice=true")
    strict = rows_of(probe(tmp_path / "strict", capsys, *arguments, *rule), "swap")
    assert strict["oracle"]["n_warranted_choice"] == N
    assert (strict["body_memory"]["n_warranted_choice"], strict["body_memory"]["n_sensitivity"]) == (0, 0)


def test_a_probe_of_all_kinds_has_a_row_each_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--task", "ChainOfColors3-v0", "--policy", "oracle", "--delay", "0", "12"]
    kinds = "swap,order,blank,freeze,mask,shuffle,late,delay,distractor,interference,reset"
    arguments += ["--probe", kinds, "--mask", "elsewhere", "--late", "5", "--no-controls"]
    n = 3  # it fails in none
    found = probe(tmp_path, capsys, *arguments, n=n)
    assert [(row["intervention"], row["level"]) for row in found["rows"]] == [
        ("none", None),
        ("swap", 1),
        ("order", 1),
        ("blank", None),
        ("freeze", None),
        ("mask", "elsewhere"),
        ("shuffle", None),
        ("late", 5),
        ("delay", 0),
        ("delay", 12),
        ("distractor", 3),
        ("interference", None),
        ("reset", 15),  # three cubes for five steps each
        ("reset", 20),
    ]
    assert found["rows"][0]["cue_inference_steps"] == list(range(15))
    assert all(set(row) >= REQUIRED for row in found["rows"])
    assert found["rows"][0]["sensitivity"] is None
    assert found["rows"][2]["warranted_choice"] == 1.0
    (curve,) = found["retention"]
    assert [point["delay_steps"] for point in curve["points"]] == [0, 5, 12]
    assert (curve["half_life_steps"], curve["half_life_state"]) == (None, "beyond_longest_delay")
    assert "follows both orders in 3 of 3 pairs" in found["sentences"][0]
    assert "after a delay of 12 steps in 3 of 3" in found["sentences"][0]
    assert "half-life more than 12 steps" in found["sentences"][0]
    assert [row["items_kept"] for row in found["rows"]] == pytest.approx([3.0] * 14, abs=1e-5)
    assert {row["n_order_mistakes"] for row in found["rows"]} == {0}
    assert (
        (tmp_path.parent / f"{tmp_path.name}_ChainOfColors3-v0_follows.png")
        .read_bytes()
        .startswith(b"\x89PNG")
    )

    again = ["probe", *arguments, *FAKE, "--episodes", str(n), "--out", str(tmp_path), "--format"]
    shown = {}
    for style in ("markdown", "csv", "latex"):
        assert main([*again, style]) == 0
        output = capsys.readouterr()
        shown[style] = output.out
        assert output.err.count(f"all {n} episodes are there") == 14
    lines = shown["markdown"].splitlines()
    assert lines[0].startswith("All rows: task ChainOfColors3-v0, policy oracle, K 1, pairs 3")
    assert " ".join(lines[4].split()).startswith("| none | — |")
    table = list(csv.DictReader(io.StringIO(shown["csv"])))
    assert (len(table), table[0]["sensitivity"], table[1]["sensitivity"]) == (14, "", "1.0")
    assert "\\toprule" in shown["latex"]


def test_a_task_without_phases_is_probed_by_its_cue_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = probe(tmp_path, capsys, "--task", "InterceptMedium-v0", "--policy", "random")
    assert list(rows_of(found, "none")) == ["random", "oracle", "cue_blind"]
    assert {row["intervention"] for row in found["rows"]} == {"none", "swap"}
    oracle = rows_of(found, "swap")["oracle"]
    assert (oracle["change_of"], oracle["p_value"]) == ("actions", None)
    assert oracle["sensitivity"] == 1.0
    assert rows_of(found, "swap")["random"]["sensitivity"] == 0.0  # the same draws in both worlds


def test_a_drop_that_the_oracle_shares_is_one_of_chunk_and_phase(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A chunk of 60 is predicted before the response and never replaced."""
    task = ("--task", "RememberColor3-v0", "--policy", "oracle", "--no-controls")
    found = probe(tmp_path, capsys, *task, "--probe", "swap", "--n-action-steps", "1", "60")
    assert [(row["n_action_steps"], row["n_late_steps"]) for row in found["rows"]] == [
        *((1, 0), (1, 0)),
        *((60, 50), (60, 50)),  # the response begins at step 10
    ]
    assert [row["n_without_choice"] for row in found["rows"]] == [0, 0, N, N]
    assert "follows the cue in 0 of 9 (chance 3), touching nothing in 9" in found["sentences"][1]
    (note,) = [note for note in found["notes"] if "swap 1: at K = 60" in note]
    assert "(50 steps late)" in note
    assert "in 0 of 9 instead of 9 of 9 at K = 1: chunk and phase explain" in note


def config(**fields: Any) -> EvalConfig:
    return EvalConfig(**{"name": "x", "tasks": ("RememberColor3-v0",), "policies": ("hold",), **fields})


TASK_CONFIG = config()


def test_horizons_follow_the_delay() -> None:
    probe = plan_probe(config(), ProbeSettings(probes=("delay",), delays=(0, 5, 320)))
    env = {world.level: world.config.env for world in probe.worlds}
    # 60 steps with a delay of 5, which is the world as drawn.
    assert env == {
        None: {"delay_steps": 5},
        0: {"delay_steps": 0, "horizon_steps": 55},
        320: {"delay_steps": 320, "horizon_steps": 375},
    }
    shells = plan_probe(
        config(tasks=("ShellGameTouch-v0",)), ProbeSettings(probes=("delay",), delays=(0, 40))
    )
    assert [world.config.env for world in shells.worlds] == [
        {"delay_steps": 0},
        {"delay_steps": 40, "horizon_steps": 130},
    ]


def test_a_distractor_needs_items_and_a_delay_that_is_long_enough() -> None:
    settings = ProbeSettings(probes=("swap", "distractor", "interference"), distractors=(3, 6))
    color = plan_probe(config(), settings)
    assert [(world.intervention, world.level) for world in color.worlds[2:]] == [
        ("distractor", 3),  # not 6: the delay has five steps
        ("interference", None),
    ]
    shells = plan_probe(config(tasks=("ShellGameTouch-v0",)), settings)
    assert [world.intervention for world in shells.worlds] == ["none", "swap"]
    assert len(shells.left_out) == 2


def test_a_short_cue_shortens_the_horizon_for_each_item() -> None:
    probe = plan_probe(config(tasks=("ChainOfColors3-v0",)), ProbeSettings(probes=("cue",), cues=(1, 5)))
    (_, short) = probe.worlds
    # 120 steps with three cubes for 5 steps each; 3 * 4 fewer.
    assert (short.config.env["cue_steps"], short.config.env["horizon_steps"]) == (1, 108)


@pytest.mark.parametrize(
    ("k", "in_cue", "n_late"),
    # The response begins at step 10; inferences at 0, 4, 8, 12 and at 0, 8, 16.
    [(1, (0, 1, 2, 3, 4), 0), (4, (0, 4), 2), (8, (0,), 6), (10, (0,), 0)],
)
def test_what_a_chunk_lets_a_policy_see_of_the_cue(k: int, in_cue: tuple[int, ...], n_late: int) -> None:
    phases = phases_of(task_spec("RememberColor3-v0"), {})
    assert phases is not None and not isinstance(phases, str)
    assert inferences(phases, k) == (in_cue, n_late)
    assert phases_of(task_spec("TakeItBack-v0"), {}) is None
    assert phases_of(task_spec("RememberColor3-v0"), {"cue_steps": (1, 5)}) == "cue_steps"


def test_views_and_looks_are_fields_of_the_evaluation() -> None:
    settings = ProbeSettings(probes=("freeze", "mask", "shuffle", "late", "appearance"), lates=(7,))
    color = plan_probe(config(), settings)
    assert [(one.intervention, one.level, one.config.cue_view) for one in color.worlds[:5]] == [
        ("none", None, "as_shown"),
        ("freeze", None, "first_frame"),
        ("mask", "cue", "hidden"),
        ("mask", "elsewhere", "hidden_elsewhere"),
        ("mask", "later", "hidden_later"),
    ]
    late, *looks = color.worlds[5:]
    assert (late.config.env["cue_after_steps"], late.config.env["horizon_steps"]) == (7, 67)
    assert [one.level for one in looks] == ["light", "camera", "table", "hue"]
    assert len({one.config.appearance for one in (late, *looks)}) == 5
    assert color.left_out == ("shuffle on RememberColor3-v0: its cue is not several items one after another",)

    shells = plan_probe(config(tasks=("ShellGameTouch-v0",)), settings)  # without a delay
    assert [one.level for one in shells.worlds if one.intervention == "mask"] == ["cue", "elsewhere"]
    ball = plan_probe(config(tasks=("InterceptMedium-v0",)), settings)
    assert {one.intervention for one in ball.worlds} == {"none", "appearance"}
    fake = plan_probe(config(simulator="fake"), settings)
    assert "appearance" not in {one.intervention for one in fake.worlds}


def test_what_is_not_changed_is_not_in_the_settings_that_a_run_is_resumed_by() -> None:
    plain, hidden = results_config(config()), results_config(config(cue_view="hidden"))
    assert not {"cue_view", "appearance"} & set(plain)
    assert hidden == {**plain, "cue_view": "hidden"}
    darker = results_config(config(appearance=AppearanceSettings(light=0.5)))
    assert darker["appearance"]["light"] == 0.5


def test_instructions_are_prompt_sets_other_than_that_of_the_evaluation() -> None:
    settings = ProbeSettings(probes=("instruction",))
    worlds = plan_probe(config(prompt_set="paraphrased"), settings).worlds
    assert [(world.level, world.config.prompt_set) for world in worlds] == [
        (None, "paraphrased"),
        ("other_task", "other_task"),
        ("no_content", "no_content"),
    ]


def test_a_reset_is_at_the_end_of_the_cue_and_of_the_delay_if_no_step_is_named() -> None:
    def steps(task: str, *named: int, **env: Any) -> list[int | None]:
        settings = ProbeSettings(probes=("reset",), reset_steps=named)
        worlds = plan_probe(config(tasks=(task,), env=env), settings).worlds
        return [world.config.reset_policy_at_step for world in worlds]

    assert steps("RememberColor3-v0") == [None, 5, 10]
    assert steps("ShellGameTouch-v0") == [None, 5]
    assert steps("SeqOfColors5-v0", gap_steps=2) == [None, 33, 38]  # 5 * 5 + 4 * 2, and a delay of 5
    assert steps("RememberColor3-v0", 7) == [None, 7]


def test_mistakes_are_said_before_anything_is_run(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RecipeError, match=r"env\.swap_cue: a probe sets this argument itself"):
        plan_probe(config(env={"swap_cue": 1}), ProbeSettings())
    with pytest.raises(RecipeError, match="needs phases of a fixed length"):
        plan_probe(config(env={"delay_steps": [1, 5]}), ProbeSettings())
    with pytest.raises(RecipeError, match=r"nothing to run .*it has no delay"):
        plan_probe(config(tasks=("TakeItBack-v0",)), ProbeSettings(probes=("delay",)))
    assert main(["probe", "--task", "RememberColor3-v0", "--policy", "hold", "--probe", "swapp"]) == 1
    assert "Did you mean 'swap'?" in capsys.readouterr().err
    assert main(["probe", "--task", "RememberColor3-v0", "--policy", "hold", "--delay", "-1"]) == 1
    assert "--delay -1: expected a whole number ≥ 0" in capsys.readouterr().err


def test_the_default_phases_are_those_of_the_simulator() -> None:
    for task, spec in TASKS.items():
        if spec.candidates is None:
            continue
        defaults = {}
        for cls in reversed(env_class(task_spec(task)).__mro__):
            if issubclass(cls, MemoryTableEnv):
                parameters = inspect.signature(cls.__init__).parameters
                defaults |= {name: parameter.default for name, parameter in parameters.items()}
        assert (defaults["cue_steps"], defaults["delay_steps"]) == (CUE_STEPS, default_delay_steps(spec)), (
            task
        )
