"""PNG files next to the folder of a probe, which holds run folders alone."""

from pathlib import Path

from vla_eval.errors import ReportError
from vla_eval.lock.switch import let_write


def write_beside(folder: Path, name: str, png: bytes) -> Path:
    """Write `FOLDER_NAME.png`, such as `OUT_TASK_delay.png`, and return its path.

    Raises:
        ReportError: the file cannot be written.
    """
    path = folder.parent / f"{folder.resolve().name}_{name}.png"
    let_write(path)
    try:
        path.write_bytes(png)
    except OSError as exc:
        raise ReportError(f"{path}: cannot be written ({exc.strerror or exc}). Name another --out.") from exc
    return path
