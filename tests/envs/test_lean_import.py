"""Modules that run when they are first used: the same modules, later; and ManiSkill is whole without them."""

import importlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from vla_eval.envs.lean_import import running_later

MODULES = {
    "toy_later.py": "import sys\nsys.toy_runs += 1\nanswer = 42\n"
    "def __getattr__(name):\n    return f'no {name}'\n",
    "toy_package/__init__.py": "from toy_package.part import value\n",
    "toy_package/part.py": "value = 7\n",
    "toy_broken.py": "import there_is_no_such_module\n",
    "toy_slow.py": "import time\nfirst = 1\ntime.sleep(0.3)\nlast = 2\n",
    "toy_user.py": "import toy_later, toy_package.part\nfrom toy_package import value\n",
}
NAMES = ("toy_later", "toy_package", "toy_broken", "toy_slow")


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name, text in MODULES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "toy_runs", 0, raising=False)
    for name in [name for name in sys.modules if name.startswith("toy_")]:
        monkeypatch.delitem(sys.modules, name)
    before = list(sys.meta_path)
    yield
    assert sys.meta_path == before


def imported(name: str) -> ModuleType:
    with running_later(NAMES):
        return importlib.import_module(name)


@pytest.mark.usefixtures("toys")
class TestRunningLater:
    def test_a_module_runs_once_when_a_name_is_asked_of_it(self) -> None:
        module = imported("toy_later")
        assert importlib.import_module("toy_later") is module  # also without the context
        assert (module.__name__, module.__file__ is not None, sys.toy_runs) == ("toy_later", True, 0)
        assert (module.answer, sys.toy_runs) == (42, 1)
        assert (module.other, sys.toy_runs, type(module)) == ("no other", 1, ModuleType)

    def test_a_package_runs_before_what_is_in_it(self) -> None:
        user = imported("toy_user")
        assert (user.value, user.toy_package.part.value, sys.toy_runs) == (7, 7, 0)

    def test_a_name_that_is_not_there_is_an_attribute_error(self) -> None:
        assert not hasattr(imported("toy_slow"), "other")

    def test_what_fails_to_run_says_so_to_everyone_who_asks(self) -> None:
        module = imported("toy_broken")
        for _ in range(2):
            with pytest.raises(ModuleNotFoundError, match="there_is_no_such_module"):
                _ = module.anything

    def test_a_thread_waits_until_another_has_run_the_module(self) -> None:
        module, found = imported("toy_slow"), []
        threads = [threading.Thread(target=lambda: found.append(module.last)) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == [2] * 4

    def test_modules_that_were_not_named_run_at_once(self) -> None:
        with running_later(("toy_package",)):
            importlib.import_module("toy_later")
        assert sys.toy_runs == 1


EPISODE = """
import sys
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
from vla_eval.envs.lean_import import LATER
env = make_env(EnvSettings(task="RememberColor3-v0", cameras=("base_camera", "hand_camera")))
env.reset({0: 1}, render=True)
env.step({0: env.hold_action(0)}, render=frozenset({0}))
env.close()
print(*(name for name in LATER if name not in sys.modules or type(sys.modules[name]) is type(sys)))

import matplotlib.pyplot, scipy.ndimage, trimesh
from mani_skill.utils import download_asset
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.visualization import display_images
from scipy.optimize import leastsq
box = trimesh.creation.box((1, 1, 1))
print(len(matplotlib.pyplot.figure().axes), scipy.ndimage.sum([1, 2]), callable(download_asset.download))
print(callable(leastsq), round(box.bounding_sphere.primitive.radius, 3), "PickCube-v1" in REGISTERED_ENVS)
"""


def test_an_episode_needs_none_of_them_and_other_code_gets_them() -> None:
    """If a version of ManiSkill uses one of them to run an episode, it costs time and changes nothing."""
    done = subprocess.run([sys.executable, "-c", EPISODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    unread, *found = done.stdout.splitlines()
    assert unread == ""
    assert found == ["0 3 True", "True 0.866 True"]
