"""Recipes are read strictly: what was mistyped is an error that says so."""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from tests.config.eval_configs import MINIMAL, config
from tests.evaluation.resolved import make_plan
from vla_eval.config import files
from vla_eval.config.agents import is_agent_table
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import apply_overrides, digest_of, find_recipe, list_recipes, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.errors import RecipeError, UnknownNameError, VlaEvalError
from vla_eval.evaluation.model_table import is_model_table, load_model_table
from vla_eval.strict.decoding import decode, load_yaml


class TestStrictness:
    def test_an_unknown_field_is_refused_with_the_closest_name(self) -> None:
        with pytest.raises(RecipeError) as caught:
            config("epsiodes: 5\n")

        message = str(caught.value)
        assert message.startswith("configs/x.yaml: there is no field 'epsiodes'. Did you mean 'episodes'?")
        assert "Known: name, tasks, policies" in message

    def test_an_unknown_nested_field_is_named_with_its_path(self) -> None:
        with pytest.raises(RecipeError, match=r"no field 'chunking\.mod'. Did you mean 'mode'"):
            config("chunking: {mod: receding_horizon}\n")

    def test_a_field_given_twice_is_refused_with_its_place(self) -> None:
        with pytest.raises(
            RecipeError, match=r"configs/x\.yaml: line 4, column 1: the field 'name' is given twice"
        ):
            config("name: y\n")

    def test_text_is_not_taken_for_a_list_of_letters(self) -> None:
        with pytest.raises(
            RecipeError, match=r"'tasks': expected a list, each entry text, found 'abc' \(text\).*\[abc\]"
        ):
            config(tasks="abc")

    @pytest.mark.parametrize(
        ("field", "value", "expected"),
        [
            ("episodes", True, "a whole number, found True"),
            ("episodes", 1.5, "a whole number, found 1.5"),
            ("episodes", "5", "a whole number, found '5'"),
            ("stop_at_success", 1, "true or false, found 1"),
            ("stop_at_success", "yes", "true or false, found 'yes'"),
            ("name", 7, "text, found 7"),
            ("name", None, "text, found None"),
            ("n_action_steps", [1, "2"], "a whole number, found '2'"),
            ("n_action_steps", 4, "a list, each entry a whole number or nothing, found 4"),
            ("env", [], "a mapping, found"),
            ("workers", "all", "a whole number or 'auto', found 'all'"),
            ("sim_backend", "cuda", "'cpu' or 'gpu', found 'cuda'"),
        ],
    )
    def test_a_wrong_type_is_refused_with_field_expected_and_found(
        self, field: str, value: object, expected: str
    ) -> None:
        with pytest.raises(RecipeError) as caught:
            config(**{field: value})

        assert f"'{field}" in str(caught.value)
        assert f"expected {expected}" in str(caught.value)

    def test_a_number_that_yaml_reads_as_text_gets_a_hint(self) -> None:
        with pytest.raises(RecipeError, match=r"'chunking\.ensemble_decay'.*found '1e-3' \(text\).*1\.0e-3"):
            config("chunking: {ensemble_decay: 1e-3}\n")

    def test_a_missing_field_is_named(self) -> None:
        with pytest.raises(RecipeError, match=r"configs/x\.yaml: the field 'policies' is missing"):
            decode(EvalConfig, {"name": "x", "tasks": ["a"]}, where="configs/x.yaml")

    def test_what_is_no_yaml_is_refused_with_its_place(self) -> None:
        with pytest.raises(RecipeError, match=r"configs/x\.yaml: line 5, column 1: expected"):
            config("tasks: [a\n")

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("episodes", 0),
            ("runs", 0),
            ("workers", 0),
            ("seed_start", -1),
            ("tasks", []),
            ("tasks", ["a", "a"]),
            ("n_action_steps", [0]),
            ("name", "../x"),
            ("name", ""),
            ("timeouts", {"step_seconds": 0}),
            ("chunking", {"delay_steps": -1}),
        ],
    )
    def test_a_value_out_of_its_range_is_refused(self, field: str, value: object) -> None:
        with pytest.raises(RecipeError, match=field):
            config(**{field: value})

    def test_a_whole_number_is_a_number(self) -> None:
        assert config("timeouts: {step_seconds: 3}\n").timeouts.step_seconds == 3.0

    def test_lists_become_tuples_so_that_recipes_cannot_be_changed(self) -> None:
        assert config(n_action_steps=[4, 8]).n_action_steps == (4, 8)


class TestFinding:
    def test_a_recipe_is_found_by_path_then_working_directory_then_package(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        package = find_recipe("policies", "random")
        (tmp_path / "policies").mkdir()
        own = tmp_path / "policies" / "random.yaml"
        own.write_text("version: 1\ndescription: mine\nadapter: random\n")
        elsewhere = tmp_path / "random.yaml"
        elsewhere.write_text(own.read_text())

        assert package.parent != own.parent
        assert find_recipe("policies", "random") == own
        assert find_recipe("policies", "random.yaml") == Path("random.yaml")
        assert list_recipes("policies")["random"] == own
        assert "oracle" in list_recipes("policies")

    def test_a_name_works_with_and_without_yaml(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)

        assert find_recipe("configs", "demo") == find_recipe("configs", "demo.yaml")
        assert find_recipe("configs", "configs/demo.yaml") == find_recipe("configs", "demo")

    def test_the_wheel_s_recipes_are_found_inside_the_package(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = tmp_path / "site" / "vla_eval" / "recipes_data" / "prompts"
        data.mkdir(parents=True)
        (data / "other.yaml").write_text("")
        monkeypatch.setattr(files, "PACKAGE_ROOT", tmp_path / "site" / "vla_eval")
        monkeypatch.chdir(tmp_path)

        assert list_recipes("prompts") == {"other": data / "other.yaml"}

    def test_an_unknown_recipe_is_refused_with_the_closest_name(self) -> None:
        with pytest.raises(UnknownNameError, match=r"no policies/\*\.yaml 'orcale'. Did you mean 'oracle'"):
            load_recipe("policies", "orcale", PolicyRecipe)

    def test_the_hash_is_that_of_the_file(self) -> None:
        recipe = load_recipe("policies", "random", PolicyRecipe)

        assert recipe.sha256 == hashlib.sha256(recipe.path.read_bytes()).hexdigest()

    def test_every_recipe_that_is_shipped_can_be_read_and_planned(self) -> None:
        for name in list_recipes("policies"):
            assert load_recipe("policies", name, PolicyRecipe).value.description
        tables = [name for name in list_recipes("configs") if is_model_table(name)]
        assert tables == [load_model_table(name).name for name in tables]
        papers = ["paper_offline_small", "paper_offline_table", "paper_vla_table"]
        assert tables == ["ablations", "baselines", "memory_table", *papers]
        trainings = {name for name in list_recipes("configs") if is_agent_table(name)}
        assert trainings == {"base_table", "ladder_base", "ladder_robots"}
        for name in list_recipes("configs").keys() - {*tables, *trainings}:
            loaded = load_recipe("configs", name, EvalConfig).value
            assert loaded.name == name
            assert make_plan(loaded).jobs


class TestOverrides:
    def override(self, *overrides: str) -> EvalConfig:
        data = load_yaml(MINIMAL, where="x")
        apply_overrides(data, overrides, cls=EvalConfig)
        return decode(EvalConfig, data, where="x")

    def test_values_are_read_as_yaml(self) -> None:
        changed = self.override(
            "episodes=7",
            "chunking.mode=temporal_ensemble",
            "n_action_steps=[1, 2]",
            "env.cue_steps=9",
            "env.a.b=c",
        )

        assert changed.episodes == 7
        assert changed.chunking.mode == "temporal_ensemble"
        assert changed.n_action_steps == (1, 2)
        assert changed.env == {"cue_steps": 9, "a": {"b": "c"}}

    def test_the_last_one_wins(self) -> None:
        assert self.override("episodes=7", "episodes=8").episodes == 8

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            (
                "chunking.mde=x",
                r"--set chunking\.mde=x: there is no field 'chunking\.mde'. Did you mean 'mode'",
            ),
            ("epsiodes=5", "Did you mean 'episodes'"),
            ("episodes", "expected FIELD=VALUE"),
            ("episodes.x=1", "'episodes' is a whole number, which has no fields"),
            ("tasks=abc", "expected a list"),
        ],
    )
    def test_mistakes_are_refused(self, override: str, message: str) -> None:
        with pytest.raises(RecipeError, match=message):
            self.override(override)


class TestBounds:
    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"seed_start": 2**32}, r"seed_start is 4294967296: .* at most 4294967295"),
            ({"seed_start": 2**32 - 4, "episodes": 5}, r"the last of 5 seeds would be 4294967296"),
            ({"episodes": 10**8}, r"episodes is 100000000, expected a number ≤ 1,000,000"),
            ({"runs": 10**11}, r"runs is 100000000000, expected a number ≤ 1,000,000"),
            ({"workers": 10**6}, "workers is 1000000, expected a number ≤ 1,024"),
            ({"slots_per_worker": 10**9}, "slots_per_worker is 1000000000"),
            ({"n_action_steps": [10**9]}, r"chunking\.n_action_steps is 1000000000"),
            ({"chunking": {"delay_steps": 10**9}}, r"chunking\.delay is 1000000000"),
            ({"timeouts": {"step_seconds": 1e300}}, r"timeouts\.step_seconds is 1e\+300"),
            ({"capture": {"video": 10**9}}, r"capture\.video is 1000000000"),
            ({"capture": {"frame_stride": 10**9}}, r"capture\.frame_stride is 1000000000"),
        ],
    )
    def test_a_number_that_no_run_can_have_is_refused(self, fields: dict[str, Any], message: str) -> None:
        with pytest.raises(RecipeError, match=message):
            config(**fields)

    def test_the_last_seeds_that_generators_take_are_allowed(self) -> None:
        assert config(seed_start=2**32 - 5, episodes=5).seed_start == 4_294_967_291

    def test_a_plan_of_more_episodes_than_a_folder_may_hold_is_refused(self) -> None:
        # 2 policies x 1000 runs x 1000 episodes
        with pytest.raises(RecipeError, match=r"make 2000000 episodes, expected at most 1000000"):
            make_plan(config(policies=["random", "hold"], runs=1000, episodes=1000))

    @pytest.mark.parametrize(
        ("path", "fields"),
        [
            ("chunking.ensemble_decay", {"chunking": {"ensemble_decay": float("nan")}}),
            ("chunking.ensemble_decay", {"chunking": {"ensemble_decay": 10**400}}),
            ("timeouts.step_seconds", {"timeouts": {"step_seconds": float("inf")}}),
            ("env.range[1]", {"env": {"range": [0.1, float("-inf")]}}),
        ],
    )
    def test_a_number_that_is_not_finite_is_refused(self, path: str, fields: dict[str, Any]) -> None:
        with pytest.raises(RecipeError, match="expected a finite number") as caught:
            config(**fields)
        assert f"'{path}'" in str(caught.value)

    def test_keys_that_are_no_text_do_not_disturb_a_message(self) -> None:
        with pytest.raises(RecipeError, match=r"'env\.5': expected a finite number"):
            config(env={5: float("nan")})

    def test_what_is_nested_without_end_is_refused(self) -> None:
        nested: list[Any] = []
        for _ in range(5000):
            nested = [nested]

        with pytest.raises(RecipeError, match="nested more than 50 deep"):
            config(env={"a": nested})


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ("{checkpoint: 5}", r"policy 'own': args\.checkpoint is 5, expected the path of a folder"),
        ("{checkpoint: x, base_checkpoint: [a]}", r"policy 'own': args\.base_checkpoint is \['a'\]"),
        (f"{{checkpoint: {'x' * 5000}}}", "xxx: expected a LeRobot checkpoint .* found no such folder"),
    ],
)
def test_a_checkpoint_that_can_be_no_folder_is_refused(tmp_path: Path, args: str, message: str) -> None:
    recipe = tmp_path / "own.yaml"
    recipe.write_text(f"version: 1\ndescription: d\nadapter: lerobot\nargs: {args}\n")

    with pytest.raises(VlaEvalError, match=message):
        make_plan(config(policies=[str(recipe)]))


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 5000 + ".yaml", "a\0b", "a\0b.yaml"])
def test_what_can_be_no_path_is_an_unknown_policy(name: str) -> None:
    with pytest.raises(UnknownNameError, match=r"there is no (policies|such file)"):
        make_plan(config(policies=[name]))


class TestNames:
    @pytest.mark.parametrize("name", ["=cmd", "-x", "+1", "@x", "a\nb", "...", " x"])
    def test_a_recipe_whose_name_tables_could_not_hold_is_refused(self, tmp_path: Path, name: str) -> None:
        recipe = tmp_path / f"{name}.yaml"
        recipe.write_text("version: 1\ndescription: d\nadapter: random\n")

        with pytest.raises(RecipeError, match="Rename the file"):
            load_recipe("policies", str(recipe), PolicyRecipe)

    def test_letters_of_any_language_are_letters(self, tmp_path: Path) -> None:
        recipe = tmp_path / "мой policy, №2.yaml"
        recipe.write_text("version: 1\ndescription: d\nadapter: random\n")

        assert load_recipe("policies", str(recipe), PolicyRecipe).name == "мой policy, №2"


def test_a_huge_file_is_no_recipe(tmp_path: Path) -> None:
    recipe = tmp_path / "huge.yaml"
    with recipe.open("wb") as file:
        file.truncate(10**12)  # sparse

    with pytest.raises(RecipeError, match=r"more than 1000000 characters"):
        load_recipe("policies", str(recipe), PolicyRecipe)


def test_a_digest_is_that_of_ascii_json_with_sorted_keys() -> None:
    """So that run folders and datasets of earlier versions can be resumed."""
    text = b'{"a": [2, "\\u00e9", null], "b": 0.5}'
    assert digest_of({"b": 0.5, "a": [2, "é", None]}) == hashlib.sha256(text).hexdigest()
