"""Replay datasets with progress on standard error: for `replay`, and at the end of `record`."""

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL

if TYPE_CHECKING:
    from vla_eval.cli.terminal.progress import RecordingProgress, StopRequest
    from vla_eval.data.manifest import ReplayReport

EXIT_MISMATCH = 1


def replay_each(
    datasets: Iterable[Path],
    stop: "StopRequest",
    progress: "RecordingProgress",
    *,
    episodes: Sequence[int] | None = None,
    pixels: bool = False,
    workers: int | Literal["auto"] = "auto",
    backend: Backend = LOCAL,
) -> int:
    """Replay datasets and print a line for each; return the exit code."""
    from vla_eval.data.replaying.replay import replay

    code = 0
    try:
        for dataset in datasets:
            with tempfile.TemporaryDirectory() as logs:
                report = replay(
                    dataset,
                    logs=Path(logs),
                    observer=progress,
                    episodes=episodes,
                    pixels=pixels,
                    workers=workers,
                    backend=backend,
                )
            if report is None:
                return stop.exit_code
            progress.close()
            print(describe(dataset, report), flush=True)
            code = code if report.passed else EXIT_MISMATCH
    finally:
        progress.close()
    return code


def describe(dataset: Path, report: "ReplayReport") -> str:
    """Return the outcome of a dataset's replay, in one line."""
    verdict = "as recorded" if report.passed else f"{len(report.mismatches)} MISMATCHES"
    quality = "".join(f", {camera} ≥ {psnr:.1f} dB" for camera, psnr in report.lowest_psnr_db.items())
    images = f"images compared{quality}" if report.pixels else "images not compared (--pixels)"
    return (
        f"{dataset}: {report.n_episodes} of {report.n_total} episodes replayed: {verdict}; states "
        f"{report.states_compared}; {images}"
    )
