"""What `scripts/seen_numbers.py` sees, and what an agent of numbers does with it."""

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from scripts.seen_numbers import (
    CAMERA,
    found_pixels,
    frames_of,
    make,
    pixels_of,
    points_of,
    save,
    shares_of_cells,
    surest,
    train,
)
from tests.agents.tiny_agents import ROBOT, tiny
from vla_eval.agents.train import train_agent
from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.policies.context import PolicyContext
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.interface import IMAGE_SIZE_PX

pytestmark = pytest.mark.usefixtures("in_this_process", "light_workers")


def test_what_is_seen_at_the_pixels_of_a_point_is_that_point() -> None:
    points_m = np.random.default_rng(0).uniform([-0.3, -0.3, 0.02], [0.15, 0.3, 0.02], size=(50, 3))
    pixels = pixels_of(points_m)
    assert ((pixels > 0) & (pixels < IMAGE_SIZE_PX)).all()
    np.testing.assert_allclose(points_of(pixels, 0.02), points_m, atol=1e-12)


def test_the_camera_of_the_simulator_shows_the_candidates_at_their_pixels() -> None:
    """Three cubes stand out from the empty table of the delay; each changed pixel is near one of them."""
    env = make_env(EnvSettings(task=ROBOT, cameras=(CAMERA,), privileged=True))
    images, result = {}, env.reset({0: 1}, render=True)[0]
    while result.status.phase != "response":
        images[result.status.phase] = result.observation.images[CAMERA].astype(int)
        wait = np.zeros(len(env.spec.action.dims), np.float32)
        wait[-1] = 1  # the gripper stays open
        result = env.step({0: wait}, render={0})[0]
    changed = np.abs(result.observation.images[CAMERA].astype(int) - images["delay"]).max(axis=-1) > 40
    rows, columns = np.nonzero(changed)
    pixels = pixels_of(result.observation.privileged.candidate_positions_m)  # type: ignore[union-attr]
    off_px = np.linalg.norm(np.stack([columns, rows], axis=-1)[:, None] + 0.5 - pixels, axis=-1)
    nearest = off_px.argmin(axis=1)
    assert {*nearest} == {0, 1, 2} and len(rows) >= 20
    for candidate in range(3):
        seen = np.array([columns, rows]).T[nearest == candidate] + 0.5
        assert np.linalg.norm(seen.mean(axis=0) - pixels[candidate]) < 1.5


def test_the_place_that_cells_are_taught_is_the_place_that_is_found_in_them() -> None:
    pixels = torch.rand(20, 4, 2, generator=torch.Generator().manual_seed(0)) * (IMAGE_SIZE_PX - 4) + 2
    shares = shares_of_cells(pixels)
    torch.testing.assert_close(shares.sum(dim=-1), torch.ones(20, 4))
    found, likely = found_pixels(shares.clamp(min=1e-12).log())
    np.testing.assert_allclose(found, pixels.numpy(), atol=1e-3)
    assert ((likely >= 0.25 - 1e-6) & (likely <= 1)).all()


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An agent of numbers, and a network that sees, both in the fake simulator and hardly trained."""
    root = tmp_path_factory.mktemp("seeing")
    train_agent(tiny("imitation", root / "agent"))
    frames = frames_of(ROBOT, run_seed=0, n=8, simulator="fake")
    assert {*frames.shown} == {-1, 0, 1, 2} and {*frames.are_due} == {True, False}
    for _step, network, loss in train(frames, steps=2, run_seed=0):
        assert np.isfinite(loss)
        save(root / "sight", network, task=ROBOT, height_m=0.02)
    return root / "agent", root / "sight"


def test_a_candidate_counts_where_it_was_seen_most_surely() -> None:
    found = np.zeros((2, 3))
    for where, sure in (((0.1, 0.2), (0.9, 0.3)), ((0.5, 0.6), (0.2, 0.4)), ((0.7, 0.8), (0.1, 0.1))):
        found = surest(found, np.tile(where, (2, 1)), np.array(sure))
    np.testing.assert_array_equal(found, [[0.1, 0.2, 0.9], [0.5, 0.6, 0.4]])


def test_it_acts_from_images_alone_and_episodes_do_not_share_what_was_seen(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    agent, sight = folders
    recipe = tmp_path / "seeing.yaml"
    recipe.write_text(
        "version: 1\ndescription: Sees.\nadapter: scripts.seen_numbers:make\n"
        f"args: {{agent: {agent}, sight: {sight}}}\n"
    )
    found = []
    for slots in ("1", "4"):
        out = tmp_path / slots
        flags = ["--episodes", "4", "--workers", "1", "--set", "simulator=fake", "--n-action-steps", "1"]
        chosen = ["--task", ROBOT, "--policy", str(recipe), "--set", f"slots_per_worker={slots}"]
        assert main(["eval", *chosen, *flags, "--out", str(out)]) == 0
        records = read_run(out).records
        assert all(record.error is None and record.n_frames for record in records)
        found.append({record.seed: record.trajectory_sha256 for record in records})
    assert len(found[0]) == 4 and found[0] == found[1]


def test_its_memory_holds_what_the_agent_keeps_and_what_was_seen(folders: tuple[Path, Path]) -> None:
    env = make_env(EnvSettings(task=ROBOT, simulator="fake", cameras=(CAMERA,)))
    chunking = ChunkingSpec(n_action_steps=1)
    context = PolicyContext(name="seeing", env=env.spec, chunking=chunking, n_candidates=3)
    policy = make(context, agent=str(folders[0]), sight=str(folders[1]))
    assert not policy.spec.privileged and policy.spec.cameras == (CAMERA,)
    policy.reset([EpisodeStart(slot=0, task=ROBOT, seed=1, run=0, instruction="", horizon_steps=60)])
    begun = policy.get_memory(0)
    result = env.reset({0: 1}, render=True)[0]
    first = policy.act(ObservationWindow(slot=0, frames=(result.observation,))).actions
    assert {name: part.shape for name, part in policy.get_memory(0).items()} == {
        name: part.shape for name, part in begun.items()
    }
    policy.set_memory(0, begun)
    again = policy.act(ObservationWindow(slot=0, frames=(result.observation,))).actions
    np.testing.assert_array_equal(first, again)
