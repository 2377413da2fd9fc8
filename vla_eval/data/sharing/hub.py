"""Push a complete dataset to the Hugging Face Hub, and pull one, by huggingface_hub's own means.

Not by `LeRobotDataset.push_to_hub`, which replaces the card by a template and leaves stale files behind.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple  # Any: the Hub's client is partly untyped

import httpx
from huggingface_hub import HfApi
from huggingface_hub.errors import HFValidationError, RevisionNotFoundError
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

from vla_eval.data.dataset_folder import check_complete
from vla_eval.data.facts import KINDS
from vla_eval.data.manifest import REPLAY_FILE
from vla_eval.data.sharing.card import CARD_FILE, SHEET_FILE, write_card
from vla_eval.errors import DatasetError
from vla_eval.lock.switch import let_connect, let_write
from vla_eval.storage.drafts import publish

REPO_TYPE = "dataset"
BESIDES = (*(kind.file for kind in KINDS), REPLAY_FILE, CARD_FILE, SHEET_FILE)
"""Files that belong to a dataset but are not among those it has digests of."""
PARTIAL_SUFFIX = ".partial"


class PulledDataset(NamedTuple):
    """Where a dataset came from."""

    repo_id: str
    commit: str


def push_dataset(root: Path, repo_id: str, *, private: bool = False, api: HfApi | None = None) -> str:
    """Upload a dataset, replacing what the repository USER/NAME held before; return where it is.

    A card is written if there is none. With `private`, a public repository that exists already is refused.
    `api` is the Hub's client, by default that of the user's login.

    Raises:
        DatasetError: the dataset is not complete, or the Hub refuses it.
    """
    let_connect("dataset push")
    facts = check_complete(root)
    if not (root / CARD_FILE).exists():
        write_card(root)
    api = api or HfApi()
    names = [*facts.files, *(path.as_posix() for path in BESIDES if (root / path).exists())]
    with _hub_errors(f"{root} cannot be pushed to {repo_id}"):
        api.create_repo(repo_id, repo_type=REPO_TYPE, private=private or None, exist_ok=True)
        # An existing repository keeps its visibility, whatever was asked for.
        if private and not api.repo_info(repo_id, repo_type=REPO_TYPE).private:
            raise DatasetError(
                f"{repo_id} exists and is public, and --private was given: nothing was uploaded. Choose "
                f"another name, or make the repository private on the Hub first."
            )
        commit: Any = api.upload_folder(
            repo_id=repo_id,
            folder_path=root,
            repo_type=REPO_TYPE,
            commit_message=f"{root.resolve().name}: {facts.n_frames} frames",
            allow_patterns=names,
            delete_patterns=["data/**", "videos/**", "meta/**", "images/**"],
        )
        # Without a tag of the format's version lerobot refuses the dataset.
        with suppress(RevisionNotFoundError):  # the first push
            api.delete_tag(repo_id, tag=CODEBASE_VERSION, repo_type=REPO_TYPE)
        api.create_tag(repo_id, tag=CODEBASE_VERSION, revision=str(commit.oid), repo_type=REPO_TYPE)
    return str(commit.commit_url)


def pull_dataset(
    repo_id: str, out: Path, *, revision: str | None = None, api: HfApi | None = None
) -> PulledDataset:
    """Download a dataset, USER/NAME, and check it; the folder appears when it is complete.

    After an interruption the same call resumes from `OUT.partial`. `revision` is a branch, tag or commit, by
    default the newest commit; `api` as for `push_dataset`.

    Raises:
        DatasetError: `out` exists, the Hub does not give it, or it is not a complete dataset.
    """
    let_connect("dataset pull")
    let_write(out)
    if out.exists():
        raise DatasetError(f"{out}: exists already. Name a new folder, or remove this one.")
    api = api or HfApi()
    partial = out.with_name(f"{out.name}{PARTIAL_SUFFIX}")
    partial.mkdir(parents=True, exist_ok=True)
    with _hub_errors(f"{repo_id} cannot be pulled"):
        # The commit is settled first: a push while we download must not give us half of each.
        commit = str(api.repo_info(repo_id, repo_type=REPO_TYPE, revision=revision).sha)
        api.snapshot_download(repo_id, repo_type=REPO_TYPE, revision=commit, local_dir=partial)
    shutil.rmtree(partial / ".cache", ignore_errors=True)  # the client's notes about the download
    try:
        check_complete(partial)
    except DatasetError as exc:
        shutil.rmtree(partial)
        raise DatasetError(
            f"{repo_id}: what was downloaded is not a complete dataset of this project ({exc}). Another "
            f"LeRobotDataset can be fetched by `hf download --repo-type dataset {repo_id} --local-dir DIR` "
            f"and imported by `mikasa-vla dataset convert`."
        ) from exc
    publish(partial, out)
    return PulledDataset(repo_id, commit)


@contextmanager
def _hub_errors(what: str) -> Iterator[None]:
    try:
        yield
    except (OSError, httpx.HTTPError, HFValidationError) as exc:
        reason = next((line for line in str(exc).splitlines() if line.strip()), type(exc).__name__)
        raise DatasetError(
            f"{what}: {reason} Check the name (USER/NAME), the network (HF_HUB_OFFLINE must not be set), and "
            f"the login (`hf auth login`, or the variable HF_TOKEN)."
        ) from exc
