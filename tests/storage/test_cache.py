"""Where the cache cannot be written, a command does without it, and says so once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vla_eval.storage import cache
from vla_eval.storage.cache import cache_dir, cached

TRY = """import sys
from vla_eval.lock.switch import locked
from vla_eval.storage.cache import cached
with locked():
    for name in ("frames/a", "frames/b", "robots/c"):
        place = cached(name)
        place.mkdir(parents=True)
        (place / "file").write_text("x")
        print(place)"""


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that holds `frames/old`, and cannot be written: tests may run as root, whom no mode stops."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (cache_dir() / "frames/old").mkdir(parents=True)
    monkeypatch.setattr(cache.os, "access", lambda *_: False)
    return cache_dir()


def test_what_is_there_is_used_and_what_is_new_goes_elsewhere(
    read_only: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert cached("frames/old") == read_only / "frames/old"
    assert not caplog.records
    new = cached("frames/new")
    assert new.parent.is_dir() is False and not new.is_relative_to(read_only)
    assert cached("robots/x").parents[1] == new.parents[1]
    (line,) = caplog.messages  # once
    assert "XDG_CACHE_HOME" in line and str(read_only) in line and "no permission to write" in line


@pytest.mark.parametrize("home", ["/dev/null", "/proc", None])
@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME"])
def test_a_process_without_a_cache_works_under_the_lock_and_leaves_nothing_behind(
    home: str | None, variable: str, tmp_path: Path
) -> None:
    home = home or str(tmp_path / "a-file")
    (tmp_path / "a-file").write_text("")
    environment = {"PATH": "/usr/bin", "TMPDIR": str(tmp_path), "PYTHONPATH": str(Path.cwd()), variable: home}
    done = subprocess.run(
        [sys.executable, "-c", TRY], env=environment, capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    places = done.stdout.split()
    assert len({Path(place).parents[1] for place in places}) == 1
    assert all(place.startswith(str(tmp_path)) for place in places)
    assert done.stderr.count("the cache cannot be written") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["a-file"]


def test_a_cache_that_can_be_written_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new"))
    place = cached("frames/a")
    assert place == tmp_path / "new/mikasa-vla-eval/frames/a"
    assert place.parent.is_dir()


def test_without_a_home_folder_nothing_is_made_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(cache.os.path, "expanduser", lambda path: path)  # as for a user without an entry
    monkeypatch.chdir(tmp_path)
    assert cached("frames/a").is_absolute()
    assert "there is no home folder" in caplog.text
    assert not list(tmp_path.iterdir())


NAMELESS = """import pwd
def unknown(_): raise KeyError("uid not found")
pwd.getpwuid = unknown
import getpass, sys
from vla_eval.cli.main import main
code = main(["list", "tasks"])
print(getpass.getuser())  # torch asks for it, too
sys.exit(code)"""


def test_a_user_that_has_only_a_number_can_run_commands(tmp_path: Path) -> None:
    environment = {"PATH": "/usr/bin", "PYTHONPATH": str(Path.cwd())}
    done = subprocess.run([sys.executable, "-c", NAMELESS], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == str(os.getuid())
