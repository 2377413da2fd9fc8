"""What must not be in the repository, and what must agree between its files."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from vla_eval import __version__

ROOT = Path(__file__).parents[2]

# In pieces, so that this file passes its own test. Which registry or mirror is used is the machine's
# affair, and a path of one machine means nothing on another.
HOSTS = (
    "pypi" + ".org",
    "python" + "hosted",
    "deb." + "debian",
    "archive." + "ubuntu",
    "download." + "pytorch",
)
MACHINE_PATHS = ("/root" + "/", "/work" + "/main")


def tracked_texts() -> dict[str, str]:
    """Return path -> text of the files that git knows, or skip outside a checkout."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    names = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, check=True, text=True
    ).stdout.split("\0")
    paths = {name: ROOT / name for name in names if name and (ROOT / name).is_file()}
    return {name: path.read_text(encoding="utf-8", errors="replace") for name, path in paths.items()}


@pytest.mark.parametrize("word", HOSTS + MACHINE_PATHS)
def test_no_tracked_file_names_a_registry_or_a_path_of_one_machine(word: str) -> None:
    assert [name for name, text in tracked_texts().items() if word in text] == []


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def test_constraints_are_exact_versions_and_nothing_else() -> None:
    assert "//" not in (ROOT / "constraints.txt").read_text(encoding="utf-8")
    for name, version in constraints().items():
        assert re.fullmatch(r"[A-Za-z0-9._-]+", name)
        assert re.fullmatch(r"[0-9][A-Za-z0-9.]*", version)  # no local label: it names a build


def test_every_requirement_is_pinned_within_its_range() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pins = {canonicalize_name(name): version for name, version in constraints().items()}
    for line in [*project["dependencies"], *project["optional-dependencies"]["dev"]]:
        requirement = Requirement(line)
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)])


def test_opencv_with_windows_is_not_pinned() -> None:
    assert "opencv-python" not in constraints()
    assert "opencv-python-headless" in constraints()


def test_tests_are_no_package() -> None:
    # A dependency installs a top-level package of the name `tests`.
    assert list((ROOT / "tests").rglob("__init__.py")) == []


def test_every_make_verb_is_listed_by_help() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    verbs = set(re.findall(r"^([a-z0-9-]+):", makefile, re.MULTILINE))
    described = set(re.findall(r"^([a-z0-9-]+):.*## ", makefile, re.MULTILINE))
    assert verbs == described
    assert {"setup", "demo", "test", "test-all", "lint", "bench", "clean", "help"} <= verbs


def test_the_changelog_names_changes_that_affect_results() -> None:
    assert "### Results-affecting" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_readme_is_read_in_three_minutes() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 800
    assert len(re.findall(r"(?<!!)\[[^]]+\]\([^)]+\)", text)) == 8  # links, without the image


def test_the_citation_is_of_this_version_and_names_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (citation["cff-version"], citation["title"]) == ("1.2.0", project["name"])
    assert (citation["version"], citation["license"]) == (__version__, project["license"])
    assert [one["name"] for one in citation["authors"]] == [one["name"] for one in project["authors"]]
    (paper,) = citation["references"]
    assert paper["title"].startswith("Memory, Benchmark & Robots")


OF_NO_ROOM = {"docs", "packaging", "fuzz", "gpu", "golden", "peers"}
"""Folders of tests that are neither of a room nor of a distribution in `plugins/`."""


def test_the_tree_of_the_code_that_contributors_see_is_the_tree() -> None:
    tree = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("```")
    shown = next(block for block in tree if "vla_eval/\n" in block)
    package = ROOT / "vla_eval"
    rooms = {f"{file.parent.name}/" for file in package.glob("*/__init__.py")}
    files = {file.name for file in package.glob("*.py")} - {"__init__.py"}
    missing = [name for name in sorted({*rooms, *files}) if not re.search(rf"(^|\s){re.escape(name)}", shown)]
    assert not missing
    named = set(re.findall(r"^  (\w+/)", shown, flags=re.MULTILINE))
    assert named <= rooms  # a room that is gone is gone from the page


def test_a_folder_of_tests_is_of_a_room_or_of_a_plugin() -> None:
    places = ("vla_eval/*/__init__.py", "plugins/*/*/__init__.py")
    rooms = {file.parent.name for place in places for file in ROOT.glob(place)}
    folders = {file.parent.name for file in (ROOT / "tests").glob("*/*.py")}
    assert folders <= rooms | OF_NO_ROOM


MAX_LINES = 400


def test_no_file_of_code_is_longer_than_one_subject_needs() -> None:
    places = ("vla_eval", "tests", "plugins", "scripts")
    files = [file for place in places for file in (ROOT / place).rglob("*.py")]
    long = {
        str(file.relative_to(ROOT)): n_lines
        for file in files
        if (n_lines := len(file.read_text(encoding="utf-8").split("\n")) - 1) > MAX_LINES
    }
    assert not long
