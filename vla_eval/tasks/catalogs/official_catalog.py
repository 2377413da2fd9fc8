"""The tasks of the official package `mikasa-robo-suite` 1.0.0, one row each; it need not be installed.

`official_90.csv` has the 90 tasks: ids, horizons and sentences as the classes of the package register and
declare them (MIT licence). The package's own table, `mikasa_robo_vla_envs.csv`, is not in its wheel. The
split follows from the horizon and the memory type from the family, with the counts that its documentation
states.

Source: `mikasa_robo_suite/vla/memory_envs` and `rl/memory_envs` of the wheel mikasa-robo-suite 1.0.0,
made from https://github.com/CognitiveAISystems/MIKASA-Robo, tag v1.0.0 (16634db).
"""

import csv
from collections.abc import Iterable
from dataclasses import replace
from importlib.resources import files
from typing import Any, cast

from vla_eval.tasks.catalogs.official_controls import control_fields
from vla_eval.tasks.spec import MemoryType, PhaseSource, TaskSpec

NAMESPACE_90 = "mikasa_vla/"
NAMESPACE_ORIGINAL = "mikasa_official/"
TABLE = "official_90.csv"
ENTRY_POINT = "vla_eval.envs.official:OfficialEnv"
_AS_PACKAGE = "as the official package has it"


def _row(line: dict[str, str]) -> TaskSpec:
    fields: dict[str, Any] = {"oracle": "", "oracle_sees": "there is none", "chance_success": None}
    return TaskSpec(
        id=f"{NAMESPACE_90}{line['name']}",
        version=1,
        entry_point=ENTRY_POINT,
        horizon_steps=int(line["horizon_steps"]),
        memory=cast(MemoryType, line["memory"]),
        instruction_key=f"{NAMESPACE_90}{line['name']}",
        instruction=line["instruction"],
        description=line["instruction"],
        success=_AS_PACKAGE,
        candidates=None,
        max_reward=1.0,
        suite="mikasa_vla_90",
        phase_source=cast(PhaseSource, line["phases"]),
        waits_for_choice=line["waits"] == "yes",
        **{**fields, **control_fields(line["name"])},
    )


def _read_table() -> dict[str, TaskSpec]:
    text = files("vla_eval.tasks.catalogs").joinpath(TABLE).read_text(encoding="utf-8")
    rows = [_row(line) for line in csv.DictReader(text.splitlines(), delimiter=";")]
    return {row.id: row for row in rows}


MIKASA_VLA_90 = _read_table()


def original_tasks(rows: Iterable[TaskSpec]) -> dict[str, TaskSpec]:
    """Return the package's original tasks: those of the paper, of which this package has its own versions.

    Left out are the tasks with a peg: the angle asked for is in none of the official observations.

    Args:
        rows: this package's tasks; ids, horizons and sentences are the same.
    """
    found = (
        replace(
            row,
            id=f"{NAMESPACE_ORIGINAL}{row.id}",
            version=1,
            entry_point=ENTRY_POINT,
            kwargs={},
            success=_AS_PACKAGE,
            oracle="",
            oracle_sees="there is none",
            turns_wrist=False,
            candidates=None,
            candidate_counts={},
            several_right=False,
            seen_in_one_frame=None,
            chance_success=None,
            idle_success=0.0,
            cue_marks_place=False,
            shows_one_by_one=False,
            suite="mikasa_official",
            phase_source=_original_phases(row),
        )
        for row in rows
        if not row.id.startswith("Rotate")
    )
    return {row.id: row for row in found}


def _original_phases(row: TaskSpec) -> PhaseSource:
    if row.id.startswith(("Remember", "BunchOfColors")):
        return "cue_and_delay"
    return "cue" if row.id.startswith("ShellGame") else "none"
