"""PNG files next to the folder of a probe, which holds run folders alone."""

from collections.abc import Mapping
from pathlib import Path

from vla_eval.errors import ReportError
from vla_eval.lock.switch import let_write


def write_beside(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write `FOLDER_NAME.png` for each name, or raise `ReportError`; return their paths."""
    paths = [folder.parent / f"{folder.resolve().name}_{name}.png" for name in files]
    for path, png in zip(paths, files.values(), strict=True):
        let_write(path)
        try:
            path.write_bytes(png)
        except OSError as exc:
            problem = f"cannot be written ({exc.strerror or exc}). Name another --out."
            raise ReportError(f"{path}: {problem}") from exc
    return paths
