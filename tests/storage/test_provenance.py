"""Provenance: the same machine and code give the same answer, another code a different one."""

import getpass
import json
import platform
import shutil
import subprocess
from pathlib import Path

import pytest

import vla_eval
from vla_eval.config import files
from vla_eval.storage import provenance
from vla_eval.storage.provenance import checkout_state, collect_environment


def git(folder: Path, *arguments: str) -> None:
    identity = ("-c", "user.name=n", "-c", "user.email=e")
    subprocess.run(("git", "-C", str(folder), *identity, *arguments), check=True, capture_output=True)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of one committed module, in a checkout of its own."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    folder = tmp_path / "checkout" / "package"
    folder.mkdir(parents=True)
    (folder / "module.py").write_text("x = 1\n")
    (folder.parent / "README.md").write_text("text\n")
    (folder.parent / ".gitignore").write_text("*.pyc\n")
    git(folder.parent, "init")
    git(folder.parent, "add", ".")
    git(folder.parent, "commit", "-m", "first")
    return folder


def test_what_is_looked_at_is_the_whole_package() -> None:
    root = Path(vla_eval.__file__).parent
    assert root == provenance.PACKAGE_FOLDER == files.PACKAGE_ROOT


class TestCheckout:
    def test_a_clean_checkout_has_a_commit_and_no_changes(self, package: Path) -> None:
        state = checkout_state(package)
        assert state["commit"] is not None and len(state["commit"]) == 40
        assert state["changes"] is None

    def test_an_edit_is_a_change_and_another_edit_another_change(self, package: Path) -> None:
        (package / "module.py").write_text("x = 2\n")
        first = checkout_state(package)["changes"]
        (package / "module.py").write_text("x = 3\n")
        second = checkout_state(package)["changes"]
        assert first is not None and second is not None and first != second

    def test_a_staged_edit_is_a_change(self, package: Path) -> None:
        (package / "module.py").write_text("x = 2\n")
        git(package, "add", "module.py")
        assert checkout_state(package)["changes"] is not None

    def test_an_untracked_module_is_a_change_and_so_is_its_content(self, package: Path) -> None:
        (package / "new.py").write_text("y = 1\n")
        first = checkout_state(package)["changes"]
        (package / "new.py").write_text("y = 2\n")
        assert first is not None and first != checkout_state(package)["changes"]

    def test_what_git_ignores_is_no_change(self, package: Path) -> None:
        (package / "module.pyc").write_bytes(b"compiled")
        assert checkout_state(package)["changes"] is None

    def test_an_edit_outside_the_package_is_no_change(self, package: Path) -> None:
        (package.parent / "README.md").write_text("other text\n")
        assert checkout_state(package)["changes"] is None

    def test_undoing_an_edit_gives_the_same_state_again(self, package: Path) -> None:
        before = checkout_state(package)
        (package / "module.py").write_text("x = 2\n")
        (package / "module.py").write_text("x = 1\n")
        assert checkout_state(package) == before

    def test_variables_of_a_git_hook_do_not_mislead(
        self, package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = checkout_state(package)
        monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere"))
        assert checkout_state(package) == before

    def test_an_installed_package_has_no_commit(self, tmp_path: Path) -> None:
        (tmp_path / "package").mkdir()
        assert checkout_state(tmp_path / "package") == {"commit": None, "changes": None}

    def test_a_package_installed_inside_another_checkout_is_not_taken_for_it(self, package: Path) -> None:
        installed = package.parent / ".venv" / "package"
        installed.mkdir(parents=True)
        assert checkout_state(installed) == {"commit": None, "changes": None}

    def test_without_git_the_commit_is_unknown(
        self, package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("PATH", str(tmp_path))
        assert checkout_state(package) == {"commit": None, "changes": None}


class TestEnvironment:
    @pytest.fixture(autouse=True)
    def _still(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Do not look at this checkout, which somebody may be editing."""
        monkeypatch.setattr(provenance, "PACKAGE_FOLDER", tmp_path)

    def test_two_calls_give_the_same(self) -> None:
        assert collect_environment() == collect_environment()

    def test_it_survives_json(self) -> None:
        environment = collect_environment()
        assert json.loads(json.dumps(environment, allow_nan=False)) == environment

    def test_it_names_no_host_no_user_and_no_folder(self) -> None:
        text = json.dumps(collect_environment())
        words = text.replace('"', " ").replace(",", " ").split()
        assert platform.node() not in words
        assert getpass.getuser() not in words
        assert not [word for word in words if word.startswith("/")]

    def test_a_package_that_is_not_installed_has_no_version(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(provenance, "PACKAGES", ("no-such-package",))
        assert collect_environment()["packages"] == {"no-such-package": None}


@pytest.mark.parametrize(
    ("text", "version"),
    [
        ("NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.104.05  Sat Aug 19 2023\n", "535.104.05"),
        ("NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  570.86.15  Release Build\n", "570.86.15"),
        ("something else\n", None),
    ],
)
def test_the_nvidia_driver_version_is_read_from_both_kinds_of_module(
    text: str, version: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "version").write_text(text)
    monkeypatch.setattr(provenance, "NVIDIA_VERSION_FILE", tmp_path / "version")
    assert provenance.nvidia_driver_version() == version


def test_mesa_is_unknown_without_dpkg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    provenance.mesa_version.cache_clear()
    assert provenance.mesa_version() is None
    provenance.mesa_version.cache_clear()
