"""What is in the wheel: one top-level name, every recipe, the type marker."""

import json
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("configs", "policies", "prompts", "datasets", "protocols")

LIST_RECIPES = """
import json, vla_eval, vla_eval.config.files as recipes
names = {folder: sorted(recipes.list_recipes(folder)) for folder in %r}
texts = [path.read_text(encoding="utf-8") for f in names for path in recipes.list_recipes(f).values()]
print(json.dumps({"file": vla_eval.__file__, "names": names, "all_read": all(texts)}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    """The wheel, built offline with the hatchling that is installed."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        yield archive


def test_the_only_top_level_name_is_vla_eval(wheel: zipfile.ZipFile) -> None:
    top_level = {PurePosixPath(name).parts[0] for name in wheel.namelist()}
    assert {name for name in top_level if not name.endswith(".dist-info")} == {"vla_eval"}


def test_every_module_of_the_package_is_in_the_wheel(wheel: zipfile.ZipFile) -> None:
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "vla_eval").rglob("*.py")}
    assert modules <= set(wheel.namelist())


def test_the_templates_of_the_report_page_are_in_the_wheel(wheel: zipfile.ZipFile) -> None:
    templates = [path for path in (ROOT / "vla_eval/page/templates").iterdir() if path.is_file()]
    assert {path.suffix for path in templates} == {".j2", ".css", ".js"}
    for path in templates:
        assert wheel.read(path.relative_to(ROOT).as_posix()) == path.read_bytes()


def test_the_wheel_says_that_it_is_typed(wheel: zipfile.ZipFile) -> None:
    assert "vla_eval/py.typed" in wheel.namelist()


@pytest.mark.parametrize("folder", (*FOLDERS, "checkpoints"))
def test_every_file_of_a_recipe_folder_is_in_the_wheel_unchanged(wheel: zipfile.ZipFile, folder: str) -> None:
    for path in (ROOT / folder).rglob("*"):
        if path.is_file():
            packed = f"vla_eval/recipes_data/{path.relative_to(ROOT).as_posix()}"
            assert wheel.read(packed) == path.read_bytes()


def test_recipe_folders_hold_no_code() -> None:
    # A module, and still more an __init__.py, would make `import datasets` find the wrong package.
    assert [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")] == []


def test_recipes_are_found_in_the_installed_wheel(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    wheel.extractall(site)
    script = f"import sys; sys.path.insert(0, {str(site)!r})\n{LIST_RECIPES % (FOLDERS,)}"
    command = [sys.executable, "-c", script]
    answer = json.loads(subprocess.run(command, capture_output=True, check=True, cwd=elsewhere).stdout)
    assert answer["file"].startswith(str(site))
    assert answer["names"] == {f: sorted(p.stem for p in (ROOT / f).glob("*.yaml")) for f in FOLDERS}
    assert answer["names"]["configs"]
    assert answer["all_read"]


def test_the_command_is_declared(wheel: zipfile.ZipFile) -> None:
    entry_points = next(name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "mikasa-vla = vla_eval.cli.main:main" in wheel.read(entry_points).decode()


def test_datasets_is_hugging_faces_from_the_repository_root() -> None:
    script = "import datasets; print(datasets.__file__); datasets.Dataset"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert Path(done.stdout.strip()).name == "__init__.py"
    assert ROOT / "datasets" not in Path(done.stdout.strip()).parents
