"""Recipes, features, statistics and seeds of demonstrations: what needs no process and no episode."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vla_eval.config.dataset import DatasetRecipe, fingerprint
from vla_eval.config.files import list_recipes, load_recipe
from vla_eval.data.exact_statistics import count_levels, image_statistics, vector_statistics
from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.data.recording.seed_queue import SeedQueue
from vla_eval.errors import RecipeError, RecordingError
from vla_eval.features import (
    ACTION_KEY,
    PROPRIO_KEYS,
    STATE_KEY,
    STATE_NAMES,
    dataset_features,
    proprioception,
    rotation_columns,
)
from vla_eval.strict.decoding import decode
from vla_eval.tasks.catalog import task_spec

TASK = "RememberColor3-v0"


def recipe(**fields: Any) -> DatasetRecipe:
    return decode(
        DatasetRecipe, {"name": "test", "tasks": [TASK], "simulator": "fake", **fields}, where="test"
    )


class TestRecipe:
    @pytest.mark.parametrize(
        ("seed_start", "episodes", "max_failed_seeds"),
        [(1, 1, 0), (100, 1, 0), (0, 2, 0), (0, 1, 1)],  # the last two reach seed 1
    )
    def test_seeds_of_the_evaluation_are_refused(
        self, seed_start: int, episodes: int, max_failed_seeds: int
    ) -> None:
        with pytest.raises(RecipeError, match="overlap the evaluation's seeds 1 to 100"):
            recipe(seed_start=seed_start, episodes=episodes, max_failed_seeds=max_failed_seeds)

    @pytest.mark.parametrize("fields", [{"seed_start": 101}, {"seed_start": 0, "max_failed_seeds": 0}])
    def test_seeds_beside_those_of_the_evaluation_are_allowed(self, fields: dict[str, int]) -> None:
        assert recipe(**{"episodes": 1, **fields}).tasks == (TASK,)

    def test_the_refusal_names_both_ranges(self) -> None:
        with pytest.raises(RecipeError, match=r"seeds 50 to 309, which overlap .* 1 to 100") as caught:
            recipe(seed_start=50, episodes=10)  # 50 + 10 + 250 - 1 = 309
        assert "seed_start above 100" in str(caught.value)

    @pytest.mark.parametrize(
        ("fields", "message"),
        [
            ({"episodes": 0}, "episodes is 0, expected a number ≥ 1"),
            ({"action_noise": -0.1}, "action_noise is -0.1, expected a number ≥ 0"),
            ({"tasks": [TASK, TASK]}, "none of them twice"),
            ({"encoder": {"g": 0}}, "encoder.g is 0, expected a number ≥ 1"),
            ({"encoder": {"crf": -1}}, "encoder.crf is -1, expected a number ≥ 0"),
            ({"state": "eff"}, "'eef' or 'joints'"),
        ],
    )
    def test_a_wrong_value_is_named(self, fields: dict[str, Any], message: str) -> None:
        with pytest.raises(RecipeError, match=message):
            recipe(**fields)

    def test_only_what_content_depends_on_is_in_the_fingerprint(self) -> None:
        assert fingerprint(recipe(workers=1)) == fingerprint(recipe(workers=8, name="other"))
        assert fingerprint(recipe(state="eef")) != fingerprint(recipe(state="joints"))

    @pytest.mark.parametrize("name", list_recipes("datasets"))
    def test_every_recipe_that_is_shipped_can_be_read(self, name: str) -> None:
        value = load_recipe("datasets", name, DatasetRecipe).value
        assert value.name == name
        assert all(task_spec(task).id == task for task in value.tasks)


class TestFeatures:
    def test_rotation_columns_are_those_of_the_matrix(self) -> None:
        quaternion = np.array([0.3, -0.5, 0.2, 0.7])
        matrix = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()

        columns = rotation_columns(quaternion.astype(np.float32))

        assert columns == pytest.approx(np.concatenate([matrix[:, 0], matrix[:, 1]]), abs=1e-6)
        # Both signs of a quaternion are the same rotation: no jump where one flips.
        assert rotation_columns(-quaternion.astype(np.float32)) == pytest.approx(columns, abs=1e-6)

    def test_both_proprioceptions_have_as_many_numbers_as_names(self) -> None:
        state = {
            "tcp_pose": np.array([0.1, 0.2, 0.3, 0, 1, 0, 0], dtype=np.float32),
            "qpos": np.arange(9, dtype=np.float32),
            "qvel": np.arange(9, dtype=np.float32) + 10,
        }
        kinds = proprioception(state)

        assert {kind: len(values) for kind, values in kinds.items()} == {"eef": 10, "joints": 25}
        assert {kind: len(names) for kind, names in STATE_NAMES.items()} == {"eef": 10, "joints": 25}
        # A half turn around x: x stays, y points back. Fingers at 7 and 8 are 15 apart.
        assert kinds["eef"] == pytest.approx([0.1, 0.2, 0.3, 1, 0, 0, 0, -1, 0, 15], abs=1e-6)
        assert kinds["joints"][7:16].tolist() == list(range(9))

    def test_policies_of_lerobot_take_cameras_state_and_action_alone(self) -> None:
        from lerobot.utils.feature_utils import dataset_to_policy_features

        inputs = dataset_to_policy_features(dataset_features("eef"))

        images = {"observation.images.base", "observation.images.wrist"}
        assert set(inputs) == {*images, STATE_KEY, ACTION_KEY}
        assert not set(PROPRIO_KEYS.values()) & set(inputs)


class TestExactStatistics:
    def test_quantiles_are_those_of_all_rows(self) -> None:
        # Ten episodes of five frames, constant in each: what lerobot averages to q01 = q99 = 4.5.
        rows = np.repeat(np.arange(10.0), 5)[:, None]

        found = vector_statistics(rows)

        assert found["q01"].item() == 0
        assert found["q50"].item() == 4.5
        assert found["q99"].item() == 9
        assert found["mean"].item() == 4.5
        assert found["std"].item() == pytest.approx(np.sqrt(8.25))  # (10² - 1) / 12
        assert found["count"].tolist() == [50]

    def test_a_constant_has_no_spread_at_all(self) -> None:
        found = vector_statistics(np.full((1000, 1), 0.1, dtype=np.float32))
        assert found["std"].item() == pytest.approx(0, abs=1e-12)
        assert found["min"].item() == found["max"].item()

    def test_those_of_pictures_agree_with_numpy(self) -> None:
        images = np.random.default_rng(0).integers(0, 200, (4, 16, 16, 3), dtype=np.uint8)
        pixels = images.reshape(-1, 3) / 255

        found = image_statistics(sum(count_levels(image) for image in images), n_frames=4)

        assert found["mean"].shape == (3, 1, 1)
        assert found["mean"].ravel() == pytest.approx(pixels.mean(axis=0))
        assert found["std"].ravel() == pytest.approx(pixels.std(axis=0))
        assert found["min"].ravel().tolist() == pixels.min(axis=0).tolist()
        assert found["max"].ravel().tolist() == pixels.max(axis=0).tolist()
        for name, share in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
            expected = np.quantile(pixels, share, axis=0, method="lower")
            assert found[name].ravel().tolist() == expected.tolist()


class TestSeedQueue:
    def tried(self, successes: set[int], order: list[int], **fields: Any) -> tuple[list[int], list[int], int]:
        """Return kept seeds, failed seeds and the number of tries, workers answering in some order."""
        queue = SeedQueue(plan(**fields), {})
        in_flight: list[int] = []
        n_tries = 0
        for position in order * 50:
            while queue.has_next() and len(in_flight) < len(order):
                taken = queue.take(None)
                assert taken is not None
                in_flight.append(taken.seed)
                n_tries += 1
            if not in_flight:
                break
            seed = in_flight.pop(position % len(in_flight))
            queue.add(fake_attempt(seed, succeeds=seed in successes))
        selection = queue.selection()
        return [one.seed for one in selection.kept], [one.seed for one in selection.failed], n_tries

    @pytest.mark.parametrize("order", [[0], [0, 1], [3, 1, 2, 0], [7, 0, 5, 2, 6, 1, 4, 3]])
    def test_the_lowest_successes_are_kept_whoever_answers_first(self, order: list[int]) -> None:
        successes = {1000, 1001, 1003, 1006, 1007, 1008, 1009}
        kept, failed, _ = self.tried(successes, order, episodes=5)
        assert kept == [1000, 1001, 1003, 1006, 1007]
        assert failed == [1002, 1004, 1005]

    def test_no_seed_is_tried_in_vain_by_one_worker(self) -> None:
        assert self.tried({1000, 1002}, [0], episodes=2)[2] == 3

    def test_attempts_of_an_earlier_session_are_not_tried_again(self) -> None:
        known = {seed: fake_attempt(seed, succeeds=True) for seed in (1000, 1002)}  # 1001 was in flight
        queue = SeedQueue(plan(episodes=3), known)
        taken = queue.take(None)
        assert taken is not None and taken.seed == 1001
        assert not queue.has_next()

    def test_all_seeds_are_kept_where_the_recipe_says_so(self) -> None:
        kept, failed, _ = self.tried({1000}, [0], episodes=3, keep="all")
        assert kept == [1000, 1001, 1002]
        assert failed == []

    def test_an_expert_that_fails_too_often_is_an_error(self) -> None:
        with pytest.raises(RecordingError, match="at 1 of the 5 seeds from 1000 to 1004; 3 episodes are"):
            self.tried({1000}, [0], episodes=3, max_failed_seeds=2)


def plan(**fields: Any) -> Any:
    """Return a plan as far as the choice of seeds goes."""
    return SimpleNamespace(recipe=recipe(**fields))


def fake_attempt(seed: int, *, succeeds: bool) -> Attempt:
    return Attempt(
        seed=seed,
        success_step=7 if succeeds else None,
        n_steps=12,
        cue_steps=5,
        delay_steps=5,
        actions="",
        intended_actions=None,
        states_sha256="",
    )
