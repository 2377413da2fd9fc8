"""Shaders without the table of reflections give the images of the installed ones, to the bit."""

import json
import logging
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sapien

from vla_eval.envs import shaders
from vla_eval.errors import RenderingError

INSTALLED = Path(sapien.__file__).parent / shaders.SHADERS
# One of each look: cubes, other shapes, mugs and a ball, a ball that rolls, a peg, a cube with a goal.
TASKS = ("RememberColor9-v0", "RememberShape9-v0", "ShellGameTouch-v0", "InterceptFast-v0", "TakeItBack-v0")
RENDER = """
import hashlib, json, sys
import numpy as np
from vla_eval.config.environment import EnvSettings
from vla_eval.envs import maniskill
lean, tasks = json.loads(sys.argv[1])
if not lean:
    maniskill.use_lean_shaders = lambda: False
for task in tasks:
    env = maniskill.ManiSkillEnv(
        EnvSettings(task=task, cameras=("base_camera", "hand_camera"), human_camera_stride=1)
    )
    found = [env.reset({0: 7}, render=True)[0].observation.images]
    for row in np.random.default_rng(1).uniform(-1, 1, (4, 7)).astype(np.float32):
        found.append(env.step({0: row}, render=frozenset({0}))[0].observation.images)
    for number, images in enumerate(found):
        for name in sorted(images):
            print(task, number, name, hashlib.sha256(images[name].tobytes()).hexdigest())
    env.close()
"""


def rendered(tasks: tuple[str, ...], *, lean: bool) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", RENDER, json.dumps([lean, tasks])], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.slow  # beside it, a fast test pins every line that is not as installed
def test_images_are_those_of_the_installed_shaders_to_the_bit() -> None:
    lean, installed = rendered(TASKS, lean=True), rendered(TASKS, lean=False)
    assert len(lean) == len(TASKS) * 5 * 3
    assert len({line.split()[-1] for line in lean}) > len(lean) // 2  # they are no blank images
    assert lean == installed


def test_nothing_mentions_the_table_and_all_else_is_as_installed(monkeypatch: Any, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    copy = shaders._lean_copy(INSTALLED)
    assert copy is not None and copy == shaders._lean_copy(INSTALLED)
    changed = []
    for path in sorted(path for path in INSTALLED.rglob("*") if path.is_file()):
        name = path.relative_to(INSTALLED)
        if (copy / name).read_text() != path.read_text():
            changed.append(name.as_posix())
    assert changed == [
        *("default/deferred.frag", "default/gbuffer1.frag", "default/scene_set.glsl"),
        *("minimal/composite0.frag", "minimal/gbuffer.frag"),
    ]
    assert not any(shaders.TABLE in (copy / name).read_text() for name in changed)
    assert [path.name for path in copy.parent.iterdir()] == [copy.name]  # no draft is left


def test_other_shaders_than_the_known_ones_are_used_as_installed(
    monkeypatch: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(INSTALLED, tmp_path / "sapien" / shaders.SHADERS)
    file = tmp_path / "sapien" / shaders.SHADERS / "minimal/gbuffer.frag"
    file.write_text(file.read_text().replace("vec2(roughness, dotNV)", "vec2(dotNV, roughness)"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(shaders.resources, "files", lambda package: tmp_path / "sapien")
    with caplog.at_level(logging.WARNING):
        assert not shaders.use_lean_shaders.__wrapped__()
    assert "the shaders are used as installed" in caplog.text


def test_without_a_place_for_the_copy_the_installed_ones_are_used(
    monkeypatch: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        assert not shaders.use_lean_shaders.__wrapped__()
    assert "no copy could be written" in caplog.text


def test_a_scene_that_reflects_its_surroundings_is_refused() -> None:
    scenes = [SimpleNamespace(render_system=SimpleNamespace(cubemap=cubemap)) for cubemap in (None, "a.ktx")]
    shaders.check_no_environment_map(SimpleNamespace(sub_scenes=scenes[:1]))
    with pytest.raises(RenderingError, match="has an environment map, expected none"):
        shaders.check_no_environment_map(SimpleNamespace(sub_scenes=scenes))
