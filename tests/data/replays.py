"""What the last replay of a dataset says, asked as training asks it."""

from pathlib import Path

from vla_eval.data.manifest import ReplayReport, read_replay
from vla_eval.data.replay_report import manifest_sha256, require_passed


def passed(dataset: Path) -> ReplayReport | None:
    return require_passed(dataset, read_replay(dataset), manifest_sha256(dataset))
