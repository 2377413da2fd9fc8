"""`plugins/mikasa_vla_client`: what is linked in the repository is a file in its archives."""

import ast
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PLUGIN = ROOT / "plugins" / "mikasa_vla_client"
PACKAGE = PLUGIN / "mikasa_vla_client"
LINKED = ("codec.py", "check.py", "check_client.py", "keys.py", "noise.py", "numbers.py")


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both archives; `build` makes the wheel from the unpacked sdist, so that it holds all that is needed."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(PLUGIN)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_repository_holds_links_to_the_wire() -> None:
    for name in LINKED:
        assert (PACKAGE / name).resolve() == ROOT / "vla_eval" / "wire" / name
    assert (PACKAGE / "plain_text.py").resolve() == ROOT / "vla_eval" / "plain_text.py"


def test_the_wheel_holds_every_module_as_it_is_and_nothing_else(dist: Path) -> None:
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as wheel:
        packed = {name: wheel.read(name) for name in wheel.namelist() if ".dist-info/" not in name}
    assert packed == {f"mikasa_vla_client/{path.name}": path.read_bytes() for path in PACKAGE.glob("*.py")}


def test_the_sdist_holds_files_and_no_link(dist: Path) -> None:
    with tarfile.open(next(dist.glob("*.tar.gz"))) as sdist:
        assert all(member.isfile() for member in sdist.getmembers())
        (folder,) = {member.name.partition("/")[0] for member in sdist.getmembers()}
        for path in PACKAGE.glob("*.py"):
            member = sdist.extractfile(f"{folder}/mikasa_vla_client/{path.name}")
            assert member is not None and member.read() == path.read_bytes()


@pytest.mark.parametrize("path", sorted(PACKAGE.glob("*.py")), ids=lambda path: path.name)
def test_every_module_parses_as_python_3_8_and_imports_only_what_is_declared(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))
    imported = {
        name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom) and not getattr(node, "level", 0)
        for name in (
            [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
        )
    }
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {Requirement(line).name for line in project["dependencies"]}
    assert declared == {"websockets", "msgpack", "numpy"}
    assert imported <= {*declared, "mikasa_vla_client", *sys.stdlib_module_names}


def test_the_version_is_one() -> None:
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f'__version__ = "{project["version"]}"' in (PACKAGE / "spec.py").read_text(encoding="utf-8")
