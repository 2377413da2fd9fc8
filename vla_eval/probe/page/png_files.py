"""PNG files next to the folder of a probe, which holds run folders alone."""

from collections.abc import Mapping
from pathlib import Path

from vla_eval.errors import ReportError
from vla_eval.lock.switch import let_write


def write_beside(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write `FOLDER_NAME.png` for each name, such as `OUT_TASK_delay.png`, and return their paths.

    Raises:
        ReportError: a file cannot be written.
    """
    paths = [folder.parent / f"{folder.resolve().name}_{name}.png" for name in files]
    for path, png in zip(paths, files.values(), strict=True):
        let_write(path)
        try:
            path.write_bytes(png)
        except OSError as exc:
            raise ReportError(
                f"{path}: cannot be written ({exc.strerror or exc}). Name another --out."
            ) from exc
    return paths
