"""The rooms that the command line starts with import no simulator, no torch and no viewer.

Those cost 5 to 10 s, which `--help`, `list` and `report` must not pay.
"""

import importlib
import json
import pkgutil
import subprocess
import sys
from collections.abc import Sequence

FOREIGN = ("torch", "sapien", "mani_skill", "lerobot", "cv2", "rerun")
OF_THE_PAGE = ("matplotlib", "jinja2")  # half a second; only who writes a page waits for them

CHEAP_ROOMS = (
    *(
        "config",
        "strict",
        "storage",
        "workers",
        "wire",
        "results",
        "results.published",
        "evaluation",
        "audit",
    ),
    *("probe", "studies", "cli", "cli.shared", "cli.terminal"),
)
"""What `--help`, `list`, `report` and the start of `eval` import; import-linter holds the rest."""
ALSO_CHEAP = (
    "envs.factory",
    "envs.fake",
    "policies.controls.scripted",
    "viz.capture",
    "data.recording.record",
    "data.replaying.replay",
)
CHECKS = ("testing.check_env", "testing.check_policy", "testing.check_task")  # run before torch is wanted

# Imports the modules one after the other and notes which of them brings a foreign package first.
SCRIPT = """
import importlib, json, sys
modules, foreign = json.loads(sys.argv[1])
guilty = {}
for module in modules:
    importlib.import_module(module)
    for package in foreign:
        if package in sys.modules:
            guilty.setdefault(package, module)
print(json.dumps(guilty))
"""


def import_in_order(modules: list[str], foreign: Sequence[str] = FOREIGN) -> dict[str, str]:
    """Return foreign package -> the first module that imported it, in a process of its own."""
    argument = json.dumps([modules, foreign])
    done = subprocess.run([sys.executable, "-c", SCRIPT, argument], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    guilty: dict[str, str] = json.loads(done.stdout)
    return guilty


def cheap_modules() -> list[str]:
    rooms = [importlib.import_module(f"vla_eval.{name}") for name in CHEAP_ROOMS]
    walked = [
        f"{room.__name__}.{module.name}"
        for room in rooms
        for module in pkgutil.iter_modules(room.__path__)
        if module.name != "__main__"
    ]
    return [*walked, *(f"vla_eval.{name}" for name in (*ALSO_CHEAP, *CHECKS))]


def test_cheap_modules_import_nothing_heavy() -> None:
    assert import_in_order(cheap_modules(), (*FOREIGN, *OF_THE_PAGE)) == {}


def test_a_report_page_needs_no_simulator_no_torch_and_not_pyplot() -> None:
    # pyplot keeps every figure, and asks for a display.
    assert import_in_order(["vla_eval.page.build"], (*FOREIGN, "matplotlib.pyplot")) == {}


def test_what_a_newcomer_reads_first_depends_on_numpy_alone() -> None:
    # What .pth files of the environment load at start is not ours.
    script = "import sys; idle = set(sys.modules); import vla_eval.rollout; print(*set(sys.modules) - idle)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    imported = {module.partition(".")[0] for module in done.stdout.split()}
    assert "vla_eval.core" in done.stdout.split()
    assert imported - set(sys.stdlib_module_names) <= {"numpy", "vla_eval"}


def test_the_check_itself_finds_a_heavy_import() -> None:
    assert import_in_order(["json", "cv2"]) == {"cv2": "cv2"}
