"""A policy served by `mikasa_vla_client` from an older Python with numpy 1, evaluated from here."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.peers.conftest import versions
from tests.peers.programs import PLUGIN, example, free_port, mikasa_vla, run_python, running
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run

pytestmark = pytest.mark.peer

PAGE = "another_environment.md"
TASK = ("--task", "RememberColor3-v0")


@pytest.fixture(scope="module")
def elsewhere(
    make_environment: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """An older Python with the plugin from its wheel, and one with it from its sdist."""
    dist = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(dist), str(PLUGIN)]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    return {
        kind: make_environment(str(archive), "numpy<2")
        for kind, archive in (("wheel", wheel), ("sdist", sdist))
    }


def results(out: Path) -> dict[int, tuple[str, str | None]]:
    """Return seed -> outcome and digest of the trajectory."""
    return {record.seed: (record.outcome, record.trajectory_sha256) for record in read_run(out).records}


def test_both_archives_hold_the_package(elsewhere: dict[str, Path]) -> None:
    script = (
        "import mikasa_vla_client as c, mikasa_vla_client.codec as k, os\n"
        "assert not os.path.islink(k.__file__)\n"
        "print(c.__version__)"
    )
    for python in elsewhere.values():
        done = run_python(python, "-c", script)
        assert re.fullmatch(r"\d+\.\d+\.\d+\n", done.stdout)
        found = versions(python, "numpy", "websockets", "msgpack")
        print(found)
        assert found["numpy"].startswith("1.")
        assert tuple(map(int, found["python"].split("."))) < (3, 12)


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
@pytest.mark.parametrize("name", ["numpy_policy.py", "memory_policy.py"])
def test_an_example_passes_both_checks(
    elsewhere: dict[str, Path], kind: str, name: str, tmp_path: Path
) -> None:
    port = free_port()
    (tmp_path / name).write_text(example(PAGE, name).replace("8000", str(port)))
    url = f"ws://127.0.0.1:{port}"
    with running([elsewhere[kind], name], port, cwd=tmp_path):
        assert "requirements checked, all met" in mikasa_vla("check", url)
        done = run_python(elsewhere[kind], "-m", "mikasa_vla_client", url)
    assert done.stdout.count("ok  ") > 10


def test_the_lowest_versions_that_it_declares_are_enough(
    make_environment: Callable[..., Path], elsewhere: dict[str, Path], tmp_path: Path
) -> None:
    if not versions(elsewhere["wheel"])["python"].startswith("3.8."):
        pytest.skip("msgpack 1.0.0 has wheels for Python 3.8 and no later one")
    python = make_environment(str(PLUGIN), "numpy==1.22.0", "msgpack==1.0.0", "websockets==13.0")
    port = free_port()
    name = "memory_policy.py"
    (tmp_path / name).write_text(example(PAGE, name).replace("8000", str(port)))
    with running([python, name], port, cwd=tmp_path):
        assert "requirements checked, all met" in mikasa_vla("check", f"ws://127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("simulator", "n_episodes"), [("fake", 12), pytest.param("maniskill", 4, marks=pytest.mark.slow)]
)
def test_a_server_that_is_killed_in_the_middle_costs_errors_that_a_resume_heals(
    elsewhere: dict[str, Path], simulator: str, n_episodes: int, tmp_path: Path
) -> None:
    port = free_port()
    name = "memory_policy.py"
    # The policy ends its process in the middle of the third episode that it begins.
    dying = example(PAGE, name).replace("8000", str(port)).replace(
        "        self.observe(session, observation)\n",
        "        self.observe(session, observation)\n"
        "        CueAverage.n_inferences = getattr(CueAverage, 'n_inferences', 0) + 1\n"
        "        if CueAverage.n_inferences == 35:\n"
        "            import os; os._exit(9)\n",
    )  # fmt: skip
    (tmp_path / "dying.py").write_text(dying)
    (tmp_path / name).write_text(example(PAGE, name).replace("8000", str(port)))
    url = f"ws://127.0.0.1:{port}"

    recipe = tmp_path / "elsewhere.yaml"
    recipe.write_text(
        f"version: 1\ndescription: a policy elsewhere\nadapter: remote\ndefault_n_action_steps: 4\n"
        f"args: {{url: {url}, connect_seconds: 0.5}}\n"
    )

    def evaluate(out: str, workers: int, *, code: int = 0) -> list[EpisodeRecord]:
        mikasa_vla(
            *("eval", *TASK, "--policy", recipe, "--episodes", str(n_episodes), "--workers", str(workers)),
            *("--set", f"simulator={simulator}", "--set", "max_consecutive_errors=100"),
            *("--out", tmp_path / out),
            code=code,
        )
        return list(read_run(tmp_path / out).records)

    with running([elsewhere["wheel"], name], port, cwd=tmp_path):
        evaluate("whole", 1)
    whole = results(tmp_path / "whole")
    assert len(whole) == n_episodes and all(outcome != "error" for outcome, _ in whole.values())
    with running([elsewhere["wheel"], "dying.py"], port, cwd=tmp_path):
        records = evaluate("killed", 2, code=3)
    errors = [record for record in records if record.outcome == "error"]
    assert errors and {record.error.kind for record in errors if record.error} == {"RemoteConnectionError"}
    before = results(tmp_path / "killed")
    finished = {seed: result for seed, result in before.items() if result[0] != "error"}
    assert finished and all(whole[seed] == result for seed, result in finished.items())
    with running([elsewhere["wheel"], name], port, cwd=tmp_path):
        evaluate("killed", 2)
    assert results(tmp_path / "killed") == whole
