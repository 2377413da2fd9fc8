"""Checkpoints are found by folder, by run, and by the name of one that ships."""

from pathlib import Path

import pytest

from vla_eval.checkpoints.files import find_checkpoint
from vla_eval.checkpoints.verify import Verified
from vla_eval.config import files
from vla_eval.errors import CheckpointError


@pytest.fixture(autouse=True)
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(files, "PACKAGE_ROOT", tmp_path / "package")
    write(tmp_path / "package" / "recipes_data" / "checkpoints" / "memory_small")


def write(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        (folder / name).touch()
    return folder


def test_one_that_ships_is_found_by_its_name(tmp_path: Path) -> None:
    found = find_checkpoint(Path("memory_small"))
    assert found == tmp_path / "package" / "recipes_data" / "checkpoints" / "memory_small"


def test_the_users_own_hides_it(tmp_path: Path) -> None:
    own = write(tmp_path / "work" / "checkpoints" / "memory_small")
    assert find_checkpoint(Path("memory_small")) == own


def test_a_folder_of_that_name_comes_first() -> None:
    write(Path("memory_small"))
    assert find_checkpoint(Path("memory_small")) == Path("memory_small")


def test_a_path_is_never_looked_for_elsewhere() -> None:
    with pytest.raises(CheckpointError, match=r"runs/memory_small: expected a LeRobot checkpoint"):
        find_checkpoint(Path("runs/memory_small"))


def test_a_mistyped_name_is_answered_with_the_closest_one() -> None:
    with pytest.raises(CheckpointError, match="Did you mean 'memory_small'"):
        find_checkpoint(Path("memory_smal"))


def test_the_report_of_a_check_names_each_statistic_only_if_asked() -> None:
    statistics = ("action.mean", "action.std", "observation.state.mean")
    found = Verified(
        folder=Path("run"),
        kind="act",
        n_tensors=1,
        n_parameters=2,
        n_trained=2,
        statistics=statistics,
        chunk=(1, 4, 7),
        sha256="0" * 64,
    )
    assert "statistics   3 of action, observation.state" in found.lines()
    assert f"statistics   {', '.join(statistics)}" in found.lines(verbose=True)
