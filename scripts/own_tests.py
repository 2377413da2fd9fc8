"""Let scripts import `tests` as this project's folder: an installed package has one of that name, too."""

import sys
import types
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def find_tests() -> None:
    """Make `tests` this project's folder."""
    tests = types.ModuleType("tests")
    tests.__path__ = [str(ROOT / "tests")]
    sys.modules["tests"] = tests
