"""The scripts of `scripts/`, as modules."""

import importlib.util
import sys
from pathlib import Path
from typing import Any  # a module's names

SCRIPTS = Path(__file__).parents[2] / "scripts"


def load_script(name: str) -> Any:
    if str(SCRIPTS) not in sys.path:
        sys.path.append(str(SCRIPTS))  # as if it was run: scripts import each other
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module
