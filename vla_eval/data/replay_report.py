"""What the last replay of a dataset found, kept in the dataset: training asks for it."""

import hashlib
from pathlib import Path

from vla_eval.data.manifest import MANIFEST_FILE, REPLAY_FILE, ReplayReport, read_replay, write_entry
from vla_eval.errors import DatasetError


def keep_report(dataset: Path, report: ReplayReport) -> None:
    """Write the report, unless one that is there says more.

    A mismatch is always written. A report without any is written if it is about all episodes, and does
    not hide a mismatch of images that it has not compared.
    """
    if report.passed:
        before = read_replay(dataset)
        hides = (
            before is not None
            and before.manifest_sha256 == report.manifest_sha256
            and not before.passed
            and before.pixels
            and not report.pixels
        )
        if hides or report.n_episodes < report.n_total:
            return
    write_entry(dataset / REPLAY_FILE, report)


def require_passed(dataset: Path, report: ReplayReport | None, manifest: str) -> ReplayReport | None:
    """Return the report of a dataset's last replay.

    Args:
        dataset: its folder, for messages.
        report: what `read_replay` returned.
        manifest: digest of its manifest.

    Raises:
        DatasetError: the replay has failed, or was one of another manifest.
    """
    if report is None:
        return None
    if report.manifest_sha256 != manifest:
        raise DatasetError(
            f"{dataset}: {REPLAY_FILE} is about another manifest. Replay the dataset: mikasa-vla replay "
            f"{dataset}"
        )
    if not report.passed:
        shown = "\n".join(f"  {sentence}" for sentence in report.mismatches[:5])
        raise DatasetError(
            f"{dataset}: its replay failed with {len(report.mismatches)} mismatches:\n{shown}\nWhat is "
            f"learned from it would not fit the environment. Record it again, or rebuild it from its "
            f"manifest: mikasa-vla replay {dataset} --rebuild OUT"
        )
    return report


def needs_replay(dataset: Path) -> bool:
    """Whether no replay of the whole dataset, as it is, has passed."""
    report = read_replay(dataset)
    return report is None or not report.passed or report.manifest_sha256 != manifest_sha256(dataset)


def manifest_sha256(dataset: Path) -> str:
    """Return the digest of a dataset's manifest."""
    return hashlib.sha256((dataset / MANIFEST_FILE).read_bytes()).hexdigest()
