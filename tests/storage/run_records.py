"""A run folder's description and records, for the tests of the store."""

import sys
import textwrap
from dataclasses import replace
from pathlib import Path

from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.storage.run_folder import RunDescription

# What subprocesses need to append records; `{out}` and `{n}` are filled in.
WRITER = """
    import sys
    from pathlib import Path
    from vla_eval.records import EpisodeRecord
    from vla_eval.storage.run_folder import RunDescription, RunFolder

    description = RunDescription(name="t", config={}, recipes={}, environment={}, options={}, command="x")
    out, n_keys = Path(sys.argv[1]), int(sys.argv[2])
    with RunFolder.open(out, description) as folder:
        finished = folder.finished_keys()
        for seed in range(n_keys):
            record = EpisodeRecord(task="T", policy="p", n_action_steps=1, run=0, seed=seed,
                                   outcome="success", success_once=True)
            if record.key not in finished:
                folder.append(record)
                print(seed, flush=True)
"""


def describe(**changes: object) -> RunDescription:
    values: dict[str, object] = {
        "name": "demo",
        "config": {"episodes": 50, "tasks": ["A"], "env": {}},
        "recipes": {"policies/oracle": "aa"},
        "environment": {"commit": "c1"},
        "options": {"workers": 2},
        "command": "mikasa-vla eval demo",
    }
    return RunDescription(**{**values, **changes})  # type: ignore[arg-type]


def result(seed: int, *, success: bool = True) -> EpisodeRecord:
    return EpisodeRecord(
        task="A",
        policy="oracle",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success" if success else "failure",
        success_once=success,
    )


def error(seed: int, message: str = "the GPU was lost") -> EpisodeRecord:
    failed = EpisodeError(kind="WorkerCrashed", stage="step", message=message)
    return replace(result(seed), outcome="error", success_once=None, error=failed)


def writer(out: Path, n_keys: int) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(WRITER), str(out), str(n_keys)]
