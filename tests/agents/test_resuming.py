"""A training by rewards that was stopped or killed goes on as if it had not been; its files hold no code."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.tiny_agents import BIT, TINY, StopAfter, tiny, trained
from vla_eval.agents.train import train_agent
from vla_eval.errors import TrainingError

CHECKPOINTS = "train/checkpoints"
STATE_FILES = {"optimizer.safetensors", "counts.json"}


def files_of(run: Path) -> dict[str, bytes]:
    """Return the checkpoints' files by their paths; a buffer's arrays, since npz files have times."""
    found = {}
    for file in sorted((run / CHECKPOINTS).rglob("*")):
        name = file.relative_to(run).as_posix()
        if not file.is_file() or "/last/" in name:
            continue
        if file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                found |= {f"{name}/{key}": arrays[key].tobytes() for key in arrays}
        else:
            found[name] = file.read_bytes()
    return found


@pytest.fixture(scope="module", params=[*TINY])
def whole(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, bytes]]:
    out = tmp_path_factory.mktemp("whole") / "run"
    return request.param, files_of(trained(tiny(request.param, out)))


# 24 steps of two environments: within the first, the second and the third part between checkpoints.
@pytest.mark.sampled(4)
@pytest.mark.parametrize("stops", [(3,), (11,), (9, 10), (23,)])
def test_a_training_that_was_stopped_anywhere_has_the_weights_of_one_that_was_not(
    whole: tuple[str, dict[str, bytes]], stops: tuple[int, ...], tmp_path: Path
) -> None:
    algorithm, expected = whole
    config = tiny(algorithm, tmp_path / "run")
    for n_steps in stops:
        summary = train_agent(config, is_stopping=StopAfter(n_steps))
        assert not summary.is_finished
    assert train_agent(config).is_finished
    assert files_of(tmp_path / "run") == expected


def test_a_checkpoint_that_a_kill_left_half_written_is_written_again(
    whole: tuple[str, dict[str, bytes]], tmp_path: Path
) -> None:
    algorithm, expected = whole
    config = tiny(algorithm, tmp_path / "run")
    train_agent(config, is_stopping=StopAfter(9))
    (tmp_path / "run" / CHECKPOINTS / ".partial-000000032" / "pretrained_model").mkdir(parents=True)
    assert train_agent(config).is_finished
    assert files_of(tmp_path / "run") == expected


def test_checkpoints_are_safetensors_json_and_arrays_without_pickles(
    whole: tuple[str, dict[str, bytes]], tmp_path: Path
) -> None:
    run = trained(tiny(whole[0], tmp_path / "run"))
    found = [file for file in (run / CHECKPOINTS).rglob("*") if file.is_file()]
    assert {file.suffix for file in found} <= {".safetensors", ".json", ".npz"}
    assert {file.name for file in found} >= STATE_FILES
    for file in found:
        assert file.read_bytes()[:2] != b"\x80\x04", "a pickle"
        if zipfile.is_zipfile(file):
            assert all(name.endswith(".npy") for name in zipfile.ZipFile(file).namelist())


def test_another_run_seed_gives_other_weights_and_the_same_the_same(tmp_path: Path) -> None:
    runs = [
        trained(tiny("ppo", tmp_path / name, run_seed=seed)) for name, seed in (("a", 1), ("b", 1), ("c", 2))
    ]
    a, b, c = (files_of(run)[f"{CHECKPOINTS}/000000048/pretrained_model/model.safetensors"] for run in runs)
    assert a == b != c


def test_a_finished_training_is_extended_by_more_steps_and_becomes_the_longer_one(tmp_path: Path) -> None:
    trained(tiny("ppo", tmp_path / "run", train_agent={"steps": 16}))
    assert trained(tiny("ppo", tmp_path / "run")) == tmp_path / "run"
    assert files_of(tmp_path / "run") == files_of(trained(tiny("ppo", tmp_path / "whole")))


def test_fewer_steps_than_are_done_and_a_falling_rate_are_refused(tmp_path: Path) -> None:
    trained(tiny("ppo", tmp_path / "run"))
    with pytest.raises(TrainingError, match="48 steps are done, of 48, and --steps 16 asks for fewer"):
        train_agent(tiny("ppo", tmp_path / "run", train_agent={"steps": 16}))
    falls = {"anneal_lr": True}
    trained(tiny("ppo", tmp_path / "falls", train_agent=falls))
    with pytest.raises(TrainingError, match="its learning rate falls to zero"):
        train_agent(tiny("ppo", tmp_path / "falls", train_agent={**falls, "steps": 96}))


@pytest.mark.parametrize(
    "changes", [{"run_seed": 5}, {"train_agent": {"n_envs": 4}}, {"task": "RememberShape3-v0"}]
)
def test_a_folder_of_another_training_is_refused(changes: dict[str, object], tmp_path: Path) -> None:
    trained(tiny("ppo", tmp_path / "run", train_agent={"steps": 16}))
    with pytest.raises(TrainingError, match="was started with other settings"):
        train_agent(tiny("ppo", tmp_path / "run", **{"train_agent": {"steps": 16}, **changes}))


@pytest.mark.parametrize(
    "file",
    [
        "training_state/optimizer.safetensors",
        "training_state/counts.json",
        "training_state/buffer.npz",
        "pretrained_model/model.safetensors",
    ],
)
@pytest.mark.parametrize("content", [b"", b"{}", b"\x80\x04nonsense"])
def test_a_damaged_checkpoint_is_one_message(file: str, content: bytes, tmp_path: Path) -> None:
    config = tiny("sac", tmp_path / "run")
    train_agent(config, is_stopping=StopAfter(9))
    damaged = tmp_path / "run" / CHECKPOINTS / "000000016" / file
    damaged.write_bytes(content)
    with pytest.raises(TrainingError, match=r"Remove this checkpoint's folder|restore it"):
        train_agent(config)


def test_a_buffer_of_another_shape_is_refused_and_not_cut(tmp_path: Path) -> None:
    config = tiny("sac", tmp_path / "run")
    train_agent(config, is_stopping=StopAfter(9))
    file = tmp_path / "run" / CHECKPOINTS / "000000016" / "training_state" / "buffer.npz"
    with np.load(file) as arrays:
        changed = {name: arrays[name] for name in arrays}
    changed["rewards"] = np.concatenate([changed["rewards"]] * 10)
    np.savez(file, **changed)
    with pytest.raises(TrainingError, match="cannot be read"):
        train_agent(config)


def test_metrics_have_each_step_once_after_a_stop(tmp_path: Path) -> None:
    fields = {"steps": 96, "save_every_steps": 32}
    config = tiny("ppo", tmp_path / "run", BIT, train_agent=fields)
    train_agent(config, is_stopping=StopAfter(29))
    train_agent(config)
    steps = [json.loads(line)["step"] for line in (tmp_path / "run" / "metrics.jsonl").open()]
    assert steps == [16, 32, 48, 64, 80, 96]
    assert (tmp_path / "run" / "curve.png").read_bytes().startswith(b"\x89PNG")
