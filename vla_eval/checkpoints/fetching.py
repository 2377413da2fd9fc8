"""Fetch a published checkpoint from the Hub, check and convert it. Runs none of its code."""

import contextlib
import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple  # Any: the Hub's client is partly untyped
from unittest.mock import patch

import httpx
import huggingface_hub.constants
from huggingface_hub import HfApi, hf_hub_url
from huggingface_hub.errors import GatedRepoError, HFValidationError, OfflineModeIsEnabled
from huggingface_hub.file_download import http_get
from huggingface_hub.utils import build_hf_headers, filter_repo_objects  # type: ignore[attr-defined]

from vla_eval.checkpoints.files import BASE_FILE, file_sha256, find_checkpoint
from vla_eval.errors import CheckpointError, some_of
from vla_eval.lock.switch import connecting, let_write
from vla_eval.models.family import Base, Source

DOWNLOADS = ".downloads"
PARTIAL_SUFFIX = ".part"
MARGIN_BYTES = 1 << 30  # of the disk that stays free
GB = 1e9
Say = Callable[[str], None]


class RemoteFile(NamedTuple):
    """A file of a repository: its size and, of large files, its sha256."""

    n_bytes: int
    sha256: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RemotePart:
    """What is fetched of one repository: the commit, the licence if it states one, and its files by name."""

    source: Source
    commit: str
    licence: str | None
    files: Mapping[str, RemoteFile]

    @property
    def n_bytes(self) -> int:
        """Of all files."""
        return sum(file.n_bytes for file in self.files.values())


def fetch_base(
    base: Base, out: Path, *, revision: str | None = None, api: HfApi | None = None, say: Say
) -> Path:
    """Make the folder `out` of a base, or check it; `revision` None: the pinned one."""
    if out.exists():
        say(f"{out} is there: {_check(base, out)}")
        return out
    api = api or HfApi()
    downloads = out.parent / DOWNLOADS / out.name
    let_write(out, downloads)
    sources = [
        *base.parts[:-1],
        dataclasses.replace(base.weights, revision=revision or base.weights.revision),
    ]
    with connecting("checkpoint fetch"):
        parts = [_settle(api, base, source, out) for source in sources]
        _check_disk(base, parts, downloads, say)
        for part in parts:
            folder = downloads / part.source.folder
            say(f"{part.source.repo_id}: {len(part.files)} files, {part.n_bytes / GB:.2f} GB, to {folder}")
            with _hub_errors(base, part.source, out):
                for name, remote in part.files.items():
                    _download(api, part, remote.n_bytes, name, folder / name)
            _check_files(part, folder)
    made = _publish(base, parts, downloads, out)
    say(f"{made}: {_check(base, made)}")
    return made


def _settle(api: HfApi, base: Base, source: Source, out: Path) -> RemotePart:
    with _hub_errors(base, source, out):
        info: Any = api.model_info(source.repo_id, revision=source.revision, files_metadata=True)
    siblings = {str(file.rfilename): file for file in info.siblings or ()}
    names = sorted(filter_repo_objects(siblings, allow_patterns=list(source.patterns)))
    if not names:
        raise CheckpointError(
            f"{source.repo_id}: expected files named {', '.join(source.patterns)}, found "
            f"{some_of(sorted(siblings)) or 'none'}. The repository has changed: name an older version with "
            "--revision."
        )
    outside = [name for name in names if ".." in Path(name).parts or Path(name).is_absolute()]
    if outside:
        raise CheckpointError(
            f"{source.repo_id}: expected names of files in the repository, found "
            f"{some_of(outside)}. Do not use it."
        )
    return RemotePart(
        source=source,
        commit=str(info.sha),
        licence=getattr(info.card_data, "license", None),
        files={
            name: RemoteFile(int(siblings[name].size or 0), getattr(siblings[name].lfs, "sha256", None))
            for name in names
        },
    )


def _download(api: HfApi, part: RemotePart, n_bytes: int, name: str, file: Path) -> None:
    """Fetch one file, from where an interrupted call has ended.

    Not by `snapshot_download`: since huggingface_hub 1.x it begins such a file from its first byte
    (https://github.com/huggingface/huggingface_hub/pull/4228).
    """
    if file.is_file() and file.stat().st_size == n_bytes:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f"{file.name}{PARTIAL_SUFFIX}")
    if partial.exists() and partial.stat().st_size > n_bytes:
        partial.unlink()
    url = hf_hub_url(part.source.repo_id, name, revision=part.commit, endpoint=api.endpoint)
    with partial.open("ab") as stream:
        http_get(
            url,
            stream,
            resume_size=stream.tell(),
            headers=build_hf_headers(token=api.token),
            expected_size=n_bytes,
            displayed_filename=name,
        )
    partial.replace(file)


def _check_disk(base: Base, parts: list[RemotePart], downloads: Path, say: Say) -> None:
    """Show what will be fetched under which terms, and refuse it if the disk is too small."""
    n_bytes = sum(part.n_bytes for part in parts)
    n_have = sum(file.stat().st_size for file in downloads.rglob("*") if file.is_file())
    n_converted = parts[-1].n_bytes if base.options is not None else 0
    n_needed = max(0, n_bytes - n_have) + n_converted
    existing = next(folder for folder in (downloads, *downloads.resolve().parents) if folder.is_dir())
    n_free = shutil.disk_usage(existing).free
    for part in parts:
        stated = part.licence or "none stated"
        asked = part.source.revision or "the newest"
        pinned = "" if asked == part.commit else f" (asked for: {asked})"
        say(f"{part.source.repo_id} at {part.commit}{pinned}; licence on the Hub: {stated}")
    say(f"{base.title}: {base.terms}")
    say(f"disk: {n_needed / GB:.2f} GB needed, {n_free / GB:.2f} GB free")
    if n_needed + MARGIN_BYTES > n_free:
        raise CheckpointError(
            f"{base.name}: expected {(n_needed + MARGIN_BYTES) / GB:.1f} GB of free disk at {existing}, "
            f"found {n_free / GB:.1f} GB. Free space, or name a folder on another disk with --out."
        )


def _check_files(part: RemotePart, folder: Path) -> None:
    for name, remote in part.files.items():
        file = folder / name
        n_bytes = file.stat().st_size
        if n_bytes == remote.n_bytes and (remote.sha256 is None or file_sha256(file) == remote.sha256):
            continue
        file.unlink()  # the next call fetches it again
        raise CheckpointError(
            f"{file}: expected {remote.n_bytes:,} bytes as {part.source.repo_id} describes them, found "
            f"{n_bytes:,} bytes with other content. It was removed; run the same command again."
        )


def _publish(base: Base, parts: list[RemotePart], downloads: Path, out: Path) -> Path:
    """Convert what was fetched, or give it its name; note where it came from."""
    of_parts = [
        {
            "repo_id": part.source.repo_id,
            "commit": part.commit,
            "licence": part.licence,
            "files": {name: file._asdict() for name, file in part.files.items()},
        }
        for part in parts
    ]
    note = json.dumps({"base": base.name, "terms": base.terms, "parts": of_parts}, indent=2)
    if base.options is None:
        (downloads / BASE_FILE).write_text(f"{note}\n", encoding="utf-8")
        downloads.rename(out)
        return out
    # Here and not above: a download need not wait for torch, nor lerobot's import settle HF_HUB_OFFLINE.
    from vla_eval.checkpoints.conversion import convert_base

    with _offline():
        convert_base(base, downloads, out)
    (out / BASE_FILE).write_text(f"{note}\n", encoding="utf-8")
    shutil.rmtree(downloads)
    return out


def _check(base: Base, folder: Path) -> str:
    # Here and not above: see `_publish`.
    from vla_eval.checkpoints.backbones import check_backbone
    from vla_eval.checkpoints.verify import check_structure

    with _offline():
        if base.is_backbone:
            return check_backbone(folder, base.name)
        return check_structure(find_checkpoint(folder))


@contextlib.contextmanager
def _offline() -> Iterator[None]:
    """Keep transformers and lerobot from the network, as everywhere else but in a fetch."""
    with patch.object(huggingface_hub.constants, "HF_HUB_OFFLINE", True):
        yield


@contextlib.contextmanager
def _hub_errors(base: Base, source: Source, out: Path) -> Iterator[None]:
    """Turn what the Hub's client raises into one message that names the folder to fill by hand."""
    try:
        yield
    except GatedRepoError as exc:
        raise CheckpointError(
            f"{source.repo_id}: its authors ask that you accept their terms ({base.terms}). Open the model's "
            "page on the Hub, accept them, log in with `hf auth login`, and run the same command again."
        ) from exc
    except OfflineModeIsEnabled as exc:
        raise CheckpointError(
            f"{base.name} cannot be fetched: HF_HUB_OFFLINE={os.environ.get('HF_HUB_OFFLINE', '')} forbids "
            f"connections to the Hub. Unset it, or set it to 0 for this command. {by_hand(base, out)}"
        ) from exc
    except (OSError, httpx.HTTPError, HFValidationError) as exc:
        reason = next((line for line in str(exc).splitlines() if line.strip()), type(exc).__name__)
        raise CheckpointError(
            f"{base.name} cannot be fetched: {source.repo_id}: {reason} What has arrived is kept: run the "
            f"same command again to resume. {by_hand(base, out)}"
        ) from exc


def by_hand(base: Base, out: Path) -> str:
    """Return how to fill the folder without a network."""
    target = out if base.options is None else out.with_name(f"{out.name}-original")
    lines = ["Without a network, fetch these on another machine and copy them:"]
    for part in base.parts:
        pinned = f" --revision {part.revision}" if part.revision else ""
        names = " ".join(f"--include '{pattern}'" for pattern in part.patterns)
        lines.append(f"  hf download {part.repo_id}{pinned} {names} --local-dir {target / part.folder}")
    if base.options is not None:
        from vla_eval.checkpoints.conversion import convert_command  # as above

        lines.append(f"then: {convert_command(base, target, out)}")
    return "\n".join(lines)
