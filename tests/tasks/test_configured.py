"""Names of tasks are completed where a configuration is read; fingerprints are those of the full names."""

from pathlib import Path

import pytest

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.model_table import load_model_table
from vla_eval.evaluation.resolve import resolve
from vla_eval.tasks.configured import read_configured

SHORT, FULL = ["RememberColor3", "ShellGameTouch-v0"], ("RememberColor3-v0", "ShellGameTouch-v0")


@pytest.mark.parametrize(
    ("tasks", "env", "fingerprint"),
    [
        (SHORT, {}, "21c72cb9f96174b8bdf88265f963d41600610fd7106f252b88de9e6e460d5256"),
        (list(FULL), {}, "21c72cb9f96174b8bdf88265f963d41600610fd7106f252b88de9e6e460d5256"),
        (list(FULL[::-1]), {}, "225b372a97412c99c6b9fa823f46e40516609f9568e994725782c42da3b89a70"),
        (
            ["vla_eval/RememberColor3-v0"],
            {},
            "712fa4051d01c61dc0d045b26d89a2bbd7e23ac0bbd44513e3e7f5216ad638e7",
        ),
        (
            ["RememberColor"],
            {"n_items": 4},
            "03e7fa13176ba7d988c4fa7595e53b8b01b12bfdc198459805ed14562dc2f85e",
        ),
    ],
)
def test_a_run_folder_of_an_earlier_version_is_resumed(
    tasks: list[str], env: dict[str, int], fingerprint: str
) -> None:
    """The fingerprints were made at commit 12e5f44."""
    start = {"name": "old", "tasks": tasks, "policies": ["oracle", "cue_blind"], "env": env}
    assert (
        resolve(read_configured(EvalConfig, None, folder="configs", start=start)).fingerprint == fingerprint
    )


def test_files_of_every_kind_may_leave_the_version_out(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(f"{{name: own, tasks: {SHORT}}}")
    assert read_configured(DatasetRecipe, str(file), folder="datasets").tasks == FULL
    row = f"{{name: act, policy: act, n_action_steps: [1], tasks: {SHORT[:1]}}}"
    file.write_text(f"{{name: own, datasets: data, tasks: {SHORT}, rows: [{row}]}}")
    table = load_model_table(str(file))
    assert (table.tasks, table.rows[0].tasks) == (FULL, FULL[:1])
