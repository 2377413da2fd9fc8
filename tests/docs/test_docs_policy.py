"""The policies of `docs/policies.md` and of the README, word for word."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.forked import start_command

ROOT = Path(__file__).parents[2]


def test_the_example_policy_passes_the_check_and_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs" / "policies.md").read_text()
    (policy,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (recipe,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "my_policy.py").write_text(policy)
    (tmp_path / "my_policy.yaml").write_text(recipe)
    monkeypatch.syspath_prepend(tmp_path)  # of a process that is forked; else PYTHONPATH

    def run(*arguments: str) -> str:
        done = start_command(arguments, tmp_path).wait()
        assert done.returncode == 0, done.stderr
        return done.stdout

    checked = run("check", "my_policy.yaml")
    assert "The same episode seed and observations give the same actions beside another episode." in checked
    table = run(
        "eval", "--task", "RememberColor3-v0", "--policy", "my_policy.yaml",
        "--n-action-steps", "4", "8", "--episodes", "2", "--workers", "1", "--out", str(tmp_path / "run"),
        "--set", "simulator=fake", "--format", "csv",
    )  # fmt: skip
    assert table.count("my_policy") == 2


def test_the_policy_of_the_readme_is_evaluated(tmp_path: Path) -> None:
    (policy,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(re.findall(r"^.*\S", policy, re.M)) <= 10
    small = 'n_action_steps=[1, 4, 8], episodes=2, workers=1, simulator="fake", out="run")'
    script = policy.replace("n_action_steps=[1, 4, 8])", small)
    script += "print(vla_eval.load_run('run').table('csv'))"
    (tmp_path / "mine.py").write_text(script)
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    command = [sys.executable, "mine.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if ",Mine," in line]
    assert len(rows) == 3
