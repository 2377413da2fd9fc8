"""Build an empty wheel of `opencv-python`, so that `opencv-python-headless` alone provides cv2.

sapien requires `opencv-python`, lerobot `opencv-python-headless`. Both fill the folder `cv2`, so
whichever is installed last wins, and removing one breaks the other. This wheel holds metadata only;
its version is that of the headless pin with the label `+headless`, which says where cv2 comes from.
Knows nothing of pip: `scripts/setup.sh` installs what is built here.

Usage: python scripts/opencv_record.py constraints.txt OUTPUT_FOLDER
"""

import re
import sys
import zipfile
from pathlib import Path


def build_record(version: str, folder: Path) -> Path:
    """Write the wheel and return its path."""
    version += "+headless"
    info = f"opencv_python-{version}.dist-info"
    files = {
        f"{info}/METADATA": (
            f"Metadata-Version: 2.1\nName: opencv-python\nVersion: {version}\n"
            "Summary: No files: cv2 is provided by opencv-python-headless\n"
            "Requires-Dist: opencv-python-headless\n"
        ),
        f"{info}/WHEEL": (
            "Wheel-Version: 1.0\nGenerator: opencv_record\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        ),
    }
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD"))
    wheel = folder / f"opencv_python-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return wheel


def pinned_version(constraints: Path) -> str:
    """Return the version that the constraints give for the headless package."""
    match = re.search(r"^opencv-python-headless==(\S+)$", constraints.read_text(encoding="utf-8"), re.M)
    if match is None:
        raise SystemExit(f"{constraints}: no line 'opencv-python-headless==…'")
    return match[1]


if __name__ == "__main__":
    build_record(pinned_version(Path(sys.argv[1])), Path(sys.argv[2]))
