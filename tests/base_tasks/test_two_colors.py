"""ViZDoom-Two-Colors: episodes of the original repeat from their seed, by health, place and reward."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.base_tasks.golden_episodes import GoldenEpisode, golden_episodes
from vla_eval.base_tasks.catalog import BASE_TASKS
from vla_eval.base_tasks.doom import two_colors_map as maps
from vla_eval.base_tasks.doom.doom_wad import Jump, Label, Op, Script, When, behavior, push
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.players.two_colors import Oracle
from vla_eval.lock.switch import locked

pytest.importorskip("vizdoom", reason="ViZDoom-Two-Colors needs vizdoom (extra base-3d)")

BASE, HARD, DELAYED = (f"ViZDoomTwoColors{level}-v0" for level in ("Base", "Hard", "Delay1000"))
IDS = (BASE, HARD, DELAYED)
FORWARD = 2
IS_RED_OF = {"GreenArmor": 0.0, "BlueArmor": 1.0}


@pytest.fixture
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = make_base_task(request.param, render_mode="rgb_array")
    yield made
    made.close()


def _trace(env: Any) -> list[float]:
    state = env.true_state()
    return [float(state["health"]), float(state["shaping"]), *state["pose"].tolist()]


def _repeat(env: Any, episode: GoldenEpisode) -> None:
    where = f"seed {episode.seed} {episode.policy}"
    env.reset(seed=episode.seed)
    assert _trace(env) == episode.fields["trace"][0].tolist(), where
    for step, action in enumerate(episode.actions, 1):
        _, reward, terminated, truncated, _ = env.step(int(action))
        assert reward == pytest.approx(episode.rewards[step - 1], abs=1e-9), f"{where} step {step}"
        is_last = step == len(episode.actions)
        assert (terminated or truncated) == is_last, f"{where} step {step}"
        if not is_last:  # the original shows zeros after the end
            assert _trace(env) == episode.fields["trace"][step].tolist(), f"{where} step {step}"


@pytest.mark.parametrize("env", IDS, indirect=True)
def test_episodes_of_the_original_repeat_step_by_step(env: Any, request: pytest.FixtureRequest) -> None:
    name = request.node.callspec.params["env"]
    episodes = list(golden_episodes(name))
    assert len(episodes) == 6
    for episode in episodes:
        _repeat(env, episode)


@pytest.mark.parametrize("env", IDS, indirect=True)
def test_a_seed_has_the_pillar_and_the_things_of_the_original(
    env: Any, request: pytest.FixtureRequest
) -> None:
    for episode in golden_episodes(request.node.callspec.params["env"]):
        env.reset(seed=episode.seed)
        state = env.true_state()
        assert state["is_red"] == episode.level["is_red"]
        things = json.loads(str(episode.level["objects"]))
        vests = {(IS_RED_OF[name], x, y) for name, x, y in things if name in IS_RED_OF}
        medikits = {(x, y) for name, x, y in things if name == "Medikit"}
        assert {tuple(row) for row in state["vests"].tolist()} == vests
        assert {tuple(row) for row in state["medikits"].tolist()} == medikits


@pytest.mark.parametrize("env", [BASE], indirect=True)
def test_the_pillar_is_in_view_at_first_and_gone_after_ninety_tics(env: Any) -> None:
    env.reset(seed=1)
    n_steps = 0
    while any(one.name.startswith("Tall") for one in env._game.get_state().objects):
        env.step(0)
        n_steps += 1
    assert n_steps == 23  # it is there at tic 1 + 4 * 22 = 89, not at 93


@pytest.mark.parametrize("env", [HARD], indirect=True)
def test_standing_still_lasts_until_the_acid_has_taken_all_health(env: Any) -> None:
    env.reset(seed=0)
    ended, rewards = False, []
    while not ended:
        _, reward, terminated, truncated, info = env.step(len(rewards) % 2)  # left, right
        ended = terminated or truncated
        rewards.append(reward)
    # 8 health at tics 1, 33, …: the 13th time, at tic 1 + 32 * 12 = 385, is the last: 384 tics lived.
    assert len(rewards) == 96 and terminated and not info["success"]
    assert sum(rewards) == pytest.approx(3.84)


# Green armour takes a third of 25, blue armour (red here) half: 17 and 13 are left, rounded.
@pytest.mark.parametrize(
    ("seed", "is_red", "takes_red", "change"),
    [(0, False, False, 25), (0, False, True, -13), (2, True, True, 25), (2, True, False, -17)],
)
@pytest.mark.parametrize("env", [HARD], indirect=True)
def test_a_right_vest_heals_and_a_wrong_one_hurts_after_its_own_protection(
    env: Any, seed: int, is_red: bool, takes_red: bool, change: int
) -> None:
    env.reset(seed=seed)
    assert bool(env.true_state()["is_red"]) == is_red
    walker = Oracle(BASE_TASKS[HARD].kwargs)
    for step in range(1, 90):
        before = env.true_state()
        goal = {**before, "is_red": np.array(takes_red), "health": np.array(0.0)}
        env.step(step % 2 if step <= 24 else walker.act(None, goal))  # at first it waits for health to fall
        if env.true_state()["shaping"] != 0:
            break
    acid = 8 if step % 8 == 0 else 0
    assert env.true_state()["health"] == before["health"] - acid + change
    assert env.true_state()["shaping"] == (1.0 if is_red == takes_red else -1.0)


@pytest.mark.parametrize("is_right", [True, False])
@pytest.mark.parametrize("env", [DELAYED], indirect=True)
def test_the_choice_ends_the_episode_and_decides_success(env: Any, is_right: bool) -> None:
    env.reset(seed=2)
    env._game.send_game_command("god")  # the acid is not what is tested
    is_red = bool(env.true_state()["is_red"])
    for _ in range(525):
        _, reward, terminated, truncated, _ = env.step(0)
        assert reward == 0.0 and not terminated and not truncated
    pose = env.true_state()["pose"].tolist()
    assert pose == [*map(float, maps.CHOICE_START), 0.0]
    goal = maps.CHOICE_VESTS[is_red == is_right]
    for _ in range(50):
        x, y, degrees = env.true_state()["pose"]
        error = (np.degrees(np.arctan2(goal[1] - y, goal[0] - x)) - degrees + 180) % 360 - 180
        action = FORWARD if abs(error) < 4 else 4 if error > 0 else 6
        _, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    assert terminated and reward == 0.0 and info == {"success": is_right}
    assert env.true_state()["shaping"] == (5.0 if is_right else 0.0)


@pytest.mark.parametrize("env", [DELAYED], indirect=True)
def test_no_choice_in_time_is_no_success(env: Any) -> None:
    env.reset(seed=2)
    env._game.send_game_command("god")
    for _ in range(575):
        *_, terminated, truncated, info = env.step(0)
    assert truncated and not terminated and info == {"success": False}


PLAYS = f"""
import hashlib, sys, time
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.players.two_colors import Oracle
from vla_eval.lock.switch import locked
env = make_base_task({HARD!r})
digest = hashlib.sha256(env.reset(seed=3)[0].tobytes())
for k in range(40):
    time.sleep(float(sys.argv[1]))
    digest.update(env.step(k % 8)[0].tobytes())
print(digest.hexdigest())
"""


def test_episodes_do_not_depend_on_the_process_or_the_clock_and_leave_nothing_behind(tmp_path: Path) -> None:
    work, temporary = tmp_path / "work", tmp_path / "temporary"
    work.mkdir()
    temporary.mkdir()
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": path}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", PLAYS, pause], cwd=work, env=environment, stdout=subprocess.PIPE, text=True
        )
        for pause in ("0", "0.05")
    ]
    said = [process.communicate(timeout=120)[0] for process in running]
    assert [process.returncode for process in running] == [0, 0]
    assert said[0] == said[1] and len(said[0].strip()) == 64  # the digest and nothing else
    assert list(work.iterdir()) == [] and list(temporary.iterdir()) == []


def test_two_games_of_one_process_and_a_fork_do_not_disturb_each_other() -> None:
    one, other = make_base_task(HARD), make_base_task(HARD)
    expected = _played(one, [])
    other.reset(seed=5)
    one.reset(seed=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python warns of threads, which numpy has
        child = os.fork()
    if child == 0:
        status = 1
        try:
            status = 0 if _played(one, []) == expected else 1
            one.close()
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert _played(one, [other]) == expected
    one.close()
    other.close()


def _played(env: Any, others: list[Any]) -> list[bytes]:
    env.reset(seed=4)
    images = []
    for k in range(12):
        for one in others:
            one.step(7 - k % 8)
        images.append(env.step(k % 8)[0].tobytes())
    return images


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="only setpriv ties a game to its process")
def test_a_process_that_is_killed_takes_its_game_with_it(tmp_path: Path) -> None:
    code = (
        "import time; from vla_eval.base_tasks.make import make_base_task\n"
        f"env = make_base_task({BASE!r}); env.reset(seed=0); print('ready', flush=True); time.sleep(60)"
    )
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": path}
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        (game,) = _children(process.pid)
        words = Path(f"/proc/{game}/cmdline").read_text().split("\0")
        process.kill()
    deadline = time.monotonic() + 20
    while _is_alive(game):
        assert time.monotonic() < deadline, "the game still runs"
        time.sleep(0.05)
    for left in Path("/dev/shm").glob(f"ViZDoom*{words[words.index('+viz_instance_id') + 1]}"):
        left.unlink()


def _children(process_id: int) -> list[str]:
    running = [path.name for path in Path("/proc").iterdir() if path.name.isdigit()]
    return [one for one in running if _state_and_parent(one)[1] == str(process_id)]


def _is_alive(process_id: str) -> bool:
    """Whether a process runs; one that has ended may stay in the table until somebody asks for its status."""
    return _state_and_parent(process_id)[0] not in "ZX"


def _state_and_parent(process_id: str) -> list[str]:
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{process_id}/stat").read_text().rsplit(")", 1)[1].split()[:2]
    return ["X", ""]


def test_a_game_starts_and_ends_where_only_named_places_may_be_written() -> None:
    with locked():
        env = make_base_task(BASE)
        env.reset(seed=0)
        env.step(FORWARD)
        env.close()


def test_an_image_is_made_smaller_by_interpolation_at_the_middle_of_the_new_pixels() -> None:
    from vla_eval.base_tasks.doom.two_colors import resized

    ramp = np.zeros((100, 250, 3), np.uint8)
    ramp[..., 0] = np.arange(250)
    ramp[..., 1] = np.arange(100)[:, None]
    small = resized(ramp, 40, 100)  # 2.5 old pixels for a new one
    # The middle of new pixel k is at 2.5 (k + 1/2) - 1/2 of the old ones; a ramp has that value there.
    assert np.abs(small[7, :, 0] - (2.5 * np.arange(100) + 0.75)).max() <= 0.5
    assert np.abs(small[:, 7, 1] - (2.5 * np.arange(40) + 0.75)).max() <= 0.5


def test_a_map_is_the_same_file_every_time() -> None:
    for level in maps.LEVELS.values():
        assert maps.map_file(level) == maps.map_file(level)


def test_jumps_go_to_the_byte_at_which_their_label_stands() -> None:
    loop = Label("loop")
    lump = behavior([Script(1, When.OPEN, 0, [*push(9), loop, Op.DELAY, Jump(Op.GOTO, loop)])], ["A"])
    words = np.frombuffer(lump[: len(lump) // 4 * 4], dtype="<u4").tolist()
    assert lump[:4] == b"ACS\0"
    assert words[2:7] == [3, 9, 55, 52, 16]  # header 8 bytes, PUSH 9 8 bytes, then the label
    directory = words[1] // 4
    assert words[directory : directory + 4] == [1, 1001, 8, 0]  # one script: OPEN script 1 at byte 8
    assert words[directory + 4 :] == [1, 28] and lump[28:30] == b"A\0"


def test_rows_have_the_lengths_of_the_original() -> None:
    # 2100 and 2300 tics, 4 a step
    assert [BASE_TASKS[name].horizon_steps for name in IDS] == [525, 525, 575]
