"""Build empty wheels in place of packages that must not, or cannot, be installed.

- `opencv-python`: sapien requires it, lerobot requires `opencv-python-headless`. Both fill the folder
  `cv2`, so whichever is installed last wins, and removing one breaks the other.
- `mplib`, from Python 3.13 on: mani_skill requires a version of it that exists up to 3.12. Only
  ManiSkill's own motion planning examples import it.

Such a wheel holds metadata only. Its version is the pinned one with a label that says what it is, such as
`4.13.0.92+headless`. Knows nothing of pip: `scripts/setup.sh` installs what is built here.

Usage: python scripts/empty_wheels.py constraints.txt OUTPUT_FOLDER
"""

import re
import sys
import zipfile
from pathlib import Path


def build_wheel(name: str, version: str, summary: str, folder: Path) -> Path:
    """Write a wheel without files and return its path."""
    stem = f"{name.replace('-', '_')}-{version}"
    info = f"{stem}.dist-info"
    files = {
        f"{info}/METADATA": (
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nSummary: {summary}\n"
        ),
        f"{info}/WHEEL": (
            "Wheel-Version: 1.0\nGenerator: empty_wheels\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        ),
    }
    files[f"{info}/RECORD"] = "".join(f"{file},,\n" for file in (*files, f"{info}/RECORD"))
    wheel = folder / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for file, text in files.items():
            archive.writestr(file, text)
    return wheel


def pinned_version(name: str, constraints: Path) -> str:
    """Return the version that the constraints give for a package."""
    match = re.search(rf"^{re.escape(name)}==(\S+)$", constraints.read_text(encoding="utf-8"), re.M)
    if match is None:
        raise SystemExit(f"{constraints}: no line '{name}==…'")
    return match[1]


def main(constraints: Path, folder: Path) -> None:
    """Build the empty wheels that this Python needs."""
    version = pinned_version("opencv-python-headless", constraints)
    build_wheel("opencv-python", f"{version}+headless", "Empty: opencv-python-headless has cv2", folder)
    if sys.version_info >= (3, 13):
        version = pinned_version("mplib", constraints)
        build_wheel("mplib", f"{version}+absent", "Empty: there is no mplib for this Python", folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
