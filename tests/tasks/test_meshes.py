"""Meshes of a user's folder as candidates: they rest, look as they should, and a run names them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vla_eval
from tests.config.eval_configs import config
from tests.storage.test_strict_records import VALID
from tests.tasks.made_meshes import folder_of_shapes, folder_of_things, save, shapes
from tests.tasks.made_tasks import make
from tests.tasks.test_swapped_cue import held
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import describe_env, make_env
from vla_eval.errors import RunChangedError, RunFolderError, TaskArgumentError, UnknownNameError
from vla_eval.evaluation.evaluate import describe
from vla_eval.evaluation.plan import make_plan
from vla_eval.evaluation.resolve import resolve
from vla_eval.records import EpisodeRecord
from vla_eval.tasks.arguments import pinned
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.bodies import pose_of
from vla_eval.tasks.objects.item_names import THING_NAMES, item_names

TASK = "RememberObject3-v0"
SEED = 2
NAMES = ("annulus", "brick", "capsule")
FOLDERS: dict[str, Callable[[Path], Path]] = {"shapes": folder_of_shapes, "things": folder_of_things}


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of_shapes(tmp_path_factory.mktemp("meshes") / "three", n=3)


@pytest.mark.parametrize("kind", FOLDERS)
def test_meshes_rest_where_they_are_put(tmp_path: Path, kind: str) -> None:
    n_items = 10
    env = make("RememberObject", n_items=n_items, meshes=str(FOLDERS[kind](tmp_path / "own")))
    env.reset(seed=[1])
    while not env.response_begun()[0]:
        env.step(env.hold_action())
    put = np.array([pose_of(actor)[0] for actor in env.candidates])
    for _ in range(40):
        env.step(env.hold_action())
    now = np.array([pose_of(actor)[0] for actor in env.candidates])
    assert len({actor.name for actor in env.candidates}) == n_items
    up = 1 - 2 * (now[:, 4] ** 2 + now[:, 5] ** 2)  # the z axis of each body, along the world's
    moved_m = np.linalg.norm(now[:, :3] - put[:, :3], axis=1)
    for name, metres, cosine in zip(env.candidate_names, moved_m, up, strict=True):
        rolls = name in ("sphere", "capsule")  # until a flat triangle is below
        assert metres < (0.006 if rolls else 0.0015), name
        assert cosine > np.cos(0.3 if rolls else 0.1), name
    env.close()


def test_the_other_cue_moves_no_mesh_by_a_bit(three: Path) -> None:
    drawn, right, _ = held(TASK, meshes=str(three))
    swapped, other, _ = held(TASK, meshes=str(three), swap_cue=1)
    assert other != right
    for one, two in zip(drawn, swapped, strict=True):
        np.testing.assert_array_equal(one, two)


def test_draws_are_those_of_our_own_things(three: Path) -> None:
    """Which item is right and where all lie depends on task and seed alone, so that runs can be compared."""
    found = []
    for arguments in ({}, {"meshes": str(three)}):
        env = make(TASK, **arguments)
        env.reset(seed=[4])
        found.append((env.right_candidates(0), env._slots[0, :, :2].tolist()))
        env.close()
    assert found[0] == found[1]


def test_meshes_stand_beside_clutter_of_their_names(tmp_path: Path) -> None:
    for name, shape in {"banana": "brick", "ground": "cube", "mug": "tile"}.items():
        save(shapes()[shape], tmp_path / f"{name}.stl")
    env = make(TASK, meshes=str(tmp_path), clutter=12)
    assert env.candidate_names == ("banana", "ground", "mug")
    env.reset(seed=[1])
    env.close()
    describe_env(EnvSettings(task=TASK, kwargs={"meshes": str(tmp_path), "clutter": 12}))


def pixels(seed: int, **arguments: Any) -> np.ndarray:
    settings = EnvSettings(task=TASK, kwargs={"image_size": 512, **arguments}, cameras=("base_camera",))
    env = make_env(settings)
    image = env.reset({0: seed}, render=True)[0].observation.images["base_camera"].astype(int)
    env.close()
    return image


@pytest.mark.slow
def test_a_thing_exported_as_a_mesh_looks_as_it_did(tmp_path: Path) -> None:
    """As many pixels of the same colour, elsewhere: its origin is in the middle of a circle around it."""
    all_things, folder = folder_of_things(tmp_path / "all"), tmp_path / "three"
    folder.mkdir()
    for index, name in enumerate(THING_NAMES[:3]):  # in the order of our own
        (all_things / f"{name}.glb").rename(folder / f"{index} {name}.glb")
    nothing, own, mesh = (
        pixels(SEED, **arguments) for arguments in ({"show_cue": False}, {}, {"meshes": str(folder)})
    )
    drawn, seen = (np.abs(image - nothing).max(axis=2) > 20 for image in (own, mesh))
    assert drawn.sum() > 100
    assert seen.sum() == pytest.approx(drawn.sum(), rel=0.1)
    np.testing.assert_allclose(own[drawn].mean(axis=0), mesh[seen].mean(axis=0), atol=6)


def test_a_run_names_its_meshes_and_no_path(three: Path, tmp_path: Path) -> None:
    resolved = resolve(config(tasks=[TASK], policies=["oracle"], env={"meshes": str(three)}), out=tmp_path)
    plan = make_plan(resolved)
    described = describe(resolved, plan, "")
    digest = plan.jobs[0].group.env.kwargs["meshes"].rpartition("@")[2]
    assert described.config["env"] == {"meshes": f"three@{digest}"}
    assert {name for name in described.recipes if name.startswith("meshes/")} == {
        f"meshes/{name}" for name in ("annulus.obj", "annulus.mtl", "brick.glb", "capsule.stl")
    }
    assert str(three.parent) not in json.dumps([described.config, described.recipes])
    assert any("annulus, brick, capsule" in note for note in plan.notes)


def test_records_name_the_meshes_and_another_folder_is_another_run(three: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    given: dict[str, Any] = {"policy": "oracle", "tasks": TASK, "out": out, "in_process": True}
    run = vla_eval.evaluate(**given, episodes=1, env={"meshes": str(three)})
    (record,) = run.records
    assert record.candidate_names == NAMES
    (stored,) = vla_eval.load_run(out).records
    assert stored == record
    assert item_names(record.task, 3, given=record.candidate_names) == NAMES
    other = folder_of_shapes(tmp_path / "elsewhere" / "three", n=3)
    assert len(vla_eval.evaluate(**given, episodes=2, env={"meshes": str(other)}).records) == 2
    (other / "brick.glb").unlink()
    save(shapes()["cube"], other / "brick.glb")
    with pytest.raises(RunChangedError, match=r"recipes\.meshes/brick\.glb"):
        vla_eval.evaluate(**given, episodes=2, env={"meshes": str(other)})


@pytest.mark.parametrize(
    "names", [["a", "b", "a"], ["a", "b"], ["a", "b", "c\nd"], ["a", "b", "../c"], "abc"]
)
def test_names_of_a_record_that_cannot_be_those_of_its_candidates_are_refused(names: object) -> None:
    line = json.dumps({**VALID, "candidate_names": names})
    with pytest.raises(RunFolderError, match="candidate_names"):
        EpisodeRecord.from_json(line, where="a record")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"mesh_scale": 0.5}, "without meshes: expected a folder"),
        ({"mesh_holes": True}, "without meshes: expected a folder"),
        ({"meshes": 3}, "meshes"),
        ({"meshes": "nowhere"}, "expected a folder of meshes"),
        ({"meshes": "nowhere", "mesh_scale": 0}, "expected > 0"),
        ({"meshes": "nowhere", "mesh_scale": float("inf")}, "expected"),
    ],
)
def test_impossible_arguments_are_refused_before_a_simulator_starts(
    arguments: dict[str, Any], said: str
) -> None:
    with pytest.raises(TaskArgumentError, match=said):
        describe_env(EnvSettings(task=TASK, kwargs=arguments))
    if said != "meshes":
        with pytest.raises(TaskArgumentError, match=said):
            make(TASK, **arguments)


def test_too_few_meshes_are_refused_for_the_task_that_needs_more(three: Path) -> None:
    with pytest.raises(TaskArgumentError, match="at least 5 meshes, one for each candidate, found 3"):
        describe_env(EnvSettings(task="RememberObject5-v0", kwargs={"meshes": str(three)}))


@pytest.mark.slow
@pytest.mark.parametrize("kind", FOLDERS)
@pytest.mark.parametrize("n_items", [3, 5, 9])
def test_the_expert_finds_them_and_a_blind_arm_does_not(tmp_path: Path, kind: str, n_items: int) -> None:
    folder = FOLDERS[kind](tmp_path / "own")
    run = vla_eval.evaluate(
        policy=["oracle", "cue_blind"],
        tasks=f"RememberObject{n_items}-v0",
        out=tmp_path / "run",
        episodes=20,
        workers=1,
        env={"meshes": str(folder)},
    )
    success = {
        policy: sum(bool(one.success_once) for one in run.records if one.policy == policy)
        for policy in ("oracle", "cue_blind")
    }
    assert success["oracle"] >= 19
    # At most as many as chance gives in all but 1 of 1,000 runs of 20: binomial(20, 1 / n_items).
    assert success["cue_blind"] <= {3: 13, 5: 10, 9: 8}[n_items]


@pytest.mark.parametrize(
    "task", ["RememberColor3-v0", "RememberShape3-v0", "ShellGameTouch-v0", "TakeItBack-v0"]
)
def test_a_task_that_takes_no_meshes_says_so_before_the_folder_is_looked_at(task: str) -> None:
    with pytest.raises(UnknownNameError, match=f"env of {task}: there is no argument 'meshes'"):
        pinned({"meshes": "nothing/is/there"}, [task_spec(task)])
