"""Names of devices: a wrong one, and a GPU that is not there, are refused before anything starts."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.config.eval_configs import config
from tests.evaluation.resolved import make_plan
from vla_eval.errors import MissingDependencyError, RecipeError, VlaEvalError
from vla_eval.strict.devices import check_device, refuse_missing_gpu
from vla_eval.workers import local

RECIPE = "version: 1\ndescription: d\nadapter: lerobot\nargs: {checkpoint: %s, device: %s}\n"


@pytest.mark.parametrize("device", ["auto", "cpu", "mps", "cuda", "cuda:1"])
def test_a_network_computes_on_what_torch_names(device: str) -> None:
    assert check_device(device) == device


@pytest.mark.parametrize("device", ["gpu", "GPU", "cuda:", "cuda:x", "cuda1", "0", "", "cpu:0 "])
def test_another_name_is_refused(device: str) -> None:
    with pytest.raises(RecipeError, match=r"device is '.*', expected auto, cpu, cuda, cuda:1"):
        check_device(device)
    if device not in ("gpu",):
        with pytest.raises(RecipeError, match=r"render\.backend is"):
            check_device(device, name="render.backend", renders=True)


@pytest.mark.parametrize(
    ("device", "n_gpus", "message"),
    [
        ("gpu", 0, "there are no GPUs here"),
        ("cuda", 0, "there are no GPUs here"),
        ("sapien_cuda", 0, "there are no GPUs here"),
        ("cuda:2", 2, "there are 2 GPUs here"),
        ("cuda:1", 2, None),
        ("cuda", 1, None),
        ("cpu", 0, None),
        ("auto", 0, None),
        ("pci:1", 0, None),
    ],
)
def test_a_gpu_that_is_not_there_is_refused(device: str, n_gpus: int, message: str | None) -> None:
    if message is None:
        refuse_missing_gpu(n_gpus, {"x": device})
        return
    with pytest.raises(MissingDependencyError, match=f"x is '{device}', but {message}"):
        refuse_missing_gpu(n_gpus, {"x": device})


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"simulator": "maniskill", "render": {"backend": "gpu"}}, "render.backend"),
        ({"simulator": "maniskill", "render": {"backend": "cuda"}}, "render.backend"),
        ({"simulator": "maniskill", "sim_backend": "gpu"}, "sim_backend"),
        ({"policies": ["on_device.yaml"]}, "policy 'on_device': args.device"),
    ],
)
def test_planning_refuses_a_gpu_that_is_not_there(
    fields: dict[str, Any], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "on_device.yaml").write_text(RECIPE % (tmp_path, "cuda"))
    monkeypatch.setattr(local, "visible_gpus", lambda: ())
    with pytest.raises(VlaEvalError, match=re.escape(f"{name} is '")):
        make_plan(config(**fields))


def test_planning_refuses_a_policy_s_device_that_does_not_exist(tmp_path: Path) -> None:
    (tmp_path / "on_device.yaml").write_text(RECIPE % (tmp_path, "gpu"))
    with pytest.raises(RecipeError, match=r"policy 'on_device': args.device is 'gpu', expected auto, cpu"):
        make_plan(config(policies=[str(tmp_path / "on_device.yaml")]))
