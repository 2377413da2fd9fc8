"""Push and pull against a local stand-in for the Hub: nothing here uses the network."""

import fnmatch
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError

from vla_eval.cli.main import main
from vla_eval.data.dataset_folder import check_complete
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.sharing import hub
from vla_eval.data.sharing.hub import pull_dataset, push_dataset
from vla_eval.errors import DatasetError
from vla_eval.lock.switch import let_write
from vla_eval.testing.synthetic import write_synthetic_dataset

REPO = "somebody/demos"


def refusal(error: type[Any], message: str) -> Any:
    response = httpx.Response(404, request=httpx.Request("GET", "http://127.0.0.1"))
    return error(message, response=response)


@dataclass
class LocalHub:
    """What `HfApi` is asked for here, on a folder; signatures as in huggingface_hub 1.33."""

    folder: Path
    private: dict[str, bool] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    n_commits: int = 0

    def create_repo(self, repo_id: str, *, repo_type: str, private: bool | None, exist_ok: bool) -> None:
        assert repo_type == "dataset" and exist_ok
        self.private.setdefault(repo_id, bool(private))
        (self.folder / repo_id).mkdir(parents=True, exist_ok=True)

    def repo_info(self, repo_id: str, *, repo_type: str, revision: str | None = None) -> Any:
        if repo_id not in self.private:
            raise refusal(RepositoryNotFoundError, f"404 Client Error. Repository Not Found: {repo_id}.")
        return SimpleNamespace(private=self.private[repo_id], sha=revision or f"commit{self.n_commits}")

    def upload_folder(
        self,
        *,
        repo_id: str,
        folder_path: Path,
        repo_type: str,
        commit_message: str,
        allow_patterns: list[str],
        delete_patterns: list[str],
    ) -> Any:
        repo = self.folder / repo_id
        for path in [path for path in repo.rglob("*") if path.is_file()]:
            name = path.relative_to(repo).as_posix()
            if any(fnmatch.fnmatch(name, pattern) for pattern in delete_patterns):
                path.unlink()
        for path in [path for path in folder_path.rglob("*") if path.is_file()]:
            name = path.relative_to(folder_path).as_posix()
            if any(fnmatch.fnmatch(name, pattern) for pattern in allow_patterns):
                (repo / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, repo / name)
        self.n_commits += 1
        return SimpleNamespace(oid=f"commit{self.n_commits}", commit_url=f"hub/{repo_id}/{self.n_commits}")

    def delete_tag(self, repo_id: str, *, tag: str, repo_type: str) -> None:
        if tag not in self.tags:
            raise refusal(RevisionNotFoundError, "no such tag")
        del self.tags[tag]

    def create_tag(self, repo_id: str, *, tag: str, revision: str, repo_type: str) -> None:
        assert tag not in self.tags
        self.tags[tag] = revision

    def snapshot_download(self, repo_id: str, *, repo_type: str, revision: str, local_dir: Path) -> None:
        shutil.copytree(self.folder / repo_id, local_dir, dirs_exist_ok=True)
        (local_dir / ".cache/huggingface").mkdir(parents=True)


@pytest.fixture
def api(tmp_path: Path) -> Any:
    return LocalHub(tmp_path / "hub")


def files(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def test_what_is_pulled_is_what_was_pushed(recorded: Path, tmp_path: Path, api: Any) -> None:
    push_dataset(recorded, REPO, api=api)
    pulled = pull_dataset(REPO, tmp_path / "pulled", api=api)

    assert pulled == (REPO, "commit1")
    assert files(tmp_path / "pulled") == files(recorded)
    assert {"README.md", "meta/mikasa/recording.json"} <= files(recorded).keys()
    assert len(open_local_dataset(tmp_path / "pulled")) == 55
    assert not (tmp_path / "pulled.partial").exists()


def test_lerobots_version_tag_names_the_newest_push(recorded: Path, api: Any) -> None:
    push_dataset(recorded, REPO, api=api)
    push_dataset(recorded, REPO, api=api)

    assert api.tags == {"v3.0": "commit2"}


def test_only_the_dataset_travels(recorded: Path, api: Any) -> None:
    (recorded / "notes.txt").write_text("mine")
    (recorded / "data/chunk-000/leftover.tmp").write_text("half a file")

    push_dataset(recorded, REPO, api=api)

    assert not {"notes.txt", "data/chunk-000/leftover.tmp"} & files(api.folder / REPO).keys()


def test_files_of_an_earlier_version_do_not_stay_on_the_hub(recorded: Path, api: Any) -> None:
    stale = api.folder / REPO / "videos/old/file-000.mp4"
    stale.parent.mkdir(parents=True)
    stale.touch()

    push_dataset(recorded, REPO, api=api)

    assert not stale.exists()


@pytest.mark.parametrize("private", [True, False])
def test_privacy_is_as_asked(recorded: Path, api: Any, private: bool) -> None:
    push_dataset(recorded, REPO, private=private, api=api)

    assert api.private[REPO] == private


def test_nothing_private_goes_to_a_repository_that_is_public_already(recorded: Path, api: Any) -> None:
    api.create_repo(REPO, repo_type="dataset", private=False, exist_ok=True)

    with pytest.raises(DatasetError, match="exists and is public, and --private was given"):
        push_dataset(recorded, REPO, private=True, api=api)
    assert files(api.folder / REPO) == {}


def test_an_unfinished_dataset_is_not_pushed(tmp_path: Path, api: Any) -> None:
    root = write_synthetic_dataset(tmp_path / "unfinished", n_episodes=1, n_frames=2)

    with pytest.raises(DatasetError, match="not a complete dataset"):
        push_dataset(root, REPO, api=api)
    assert api.private == {}  # not even a repository was made


def test_a_damaged_dataset_is_not_pushed(recorded: Path, api: Any) -> None:
    video = next((recorded / "videos").rglob("*.mp4"))
    content = bytearray(video.read_bytes())
    content[100] ^= 1
    video.write_bytes(content)

    with pytest.raises(DatasetError, match="content is not what was recorded"):
        push_dataset(recorded, REPO, api=api)


def test_a_damaged_download_does_not_become_a_dataset(recorded: Path, tmp_path: Path, api: Any) -> None:
    push_dataset(recorded, REPO, api=api)
    next((api.folder / REPO / "videos").rglob("*.mp4")).write_bytes(b"cut")

    with pytest.raises(DatasetError, match=r"somebody/demos: what was downloaded is not a complete dataset"):
        pull_dataset(REPO, tmp_path / "pulled", api=api)
    assert not (tmp_path / "pulled").exists()
    assert not (tmp_path / "pulled.partial").exists()


def test_a_download_that_breaks_off_goes_on(recorded: Path, tmp_path: Path, api: Any) -> None:
    push_dataset(recorded, REPO, api=api)
    whole = api.snapshot_download

    def broken(*args: Any, local_dir: Path, **kwargs: Any) -> None:
        (local_dir / "first.bin").touch()
        raise httpx.ReadTimeout("the line broke")

    api.snapshot_download = broken
    with pytest.raises(DatasetError, match=r"cannot be pulled: the line broke Check"):
        pull_dataset(REPO, tmp_path / "pulled", api=api)
    assert (tmp_path / "pulled.partial/first.bin").exists()
    api.snapshot_download = whole
    pull_dataset(REPO, tmp_path / "pulled", api=api)

    check_complete(tmp_path / "pulled")


def test_a_name_that_the_hub_does_not_know(tmp_path: Path, api: Any) -> None:
    with pytest.raises(DatasetError, match=r"nobody/nothing cannot be pulled: 404 .* Check the name"):
        pull_dataset("nobody/nothing", tmp_path / "pulled", api=api)


def test_nothing_is_overwritten(recorded: Path, api: Any) -> None:
    push_dataset(recorded, REPO, api=api)

    with pytest.raises(DatasetError, match="exists already"):
        pull_dataset(REPO, recorded, api=api)


def test_the_command_line(
    recorded: Path, tmp_path: Path, api: Any, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(hub, "HfApi", lambda: api)
    let_write(tmp_path / "hub")  # the stand-in for the Hub

    assert main(["dataset", "push", str(recorded), REPO, "--private"]) == 0
    assert main(["dataset", "pull", REPO, str(tmp_path / "pulled")]) == 0

    out = capsys.readouterr().out
    assert "hub/somebody/demos/1" in out
    assert "commit commit1, complete and checked" in out
    assert api.private[REPO]
