"""The scripts for Slurm, without Slurm: what a task of an array runs, and when it is queued again."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import submitit
from submitit.helpers import CommandFunction

from vla_eval.storage.merging import merge_runs, write_merged
from vla_eval.storage.run_folder import read_run

ROOT = Path(__file__).parents[2]
SHARDS, JOB = ROOT / "scripts/slurm/shards.sh", ROOT / "scripts/slurm/job.sh"


def write_program(path: Path, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/usr/bin/env bash\n{body}\n")
    path.chmod(0o755)
    return path


def environment(folder: Path, program: Path, **variables: str) -> dict[str, str]:
    """Return that of a task of an array; `scontrol` writes down how it is called."""
    write_program(folder / "bin/scontrol", f'echo "$@" >> "{folder}/scontrol"')
    path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "MIKASA_VLA": str(program), "SLURM_JOB_ID": "77", **variables}


@pytest.mark.parametrize("script", sorted((ROOT / "scripts/slurm").glob("*.sh")), ids=lambda path: path.name)
def test_bash_reads_the_script_and_slurm_its_first_lines(script: Path) -> None:
    subprocess.run(["bash", "-n", script], check=True)
    lines = script.read_text().splitlines()
    n_before_code = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    # sbatch reads no option after the first line that is no comment.
    assert [i for i, line in enumerate(lines) if line.startswith("#SBATCH") and i > n_before_code] == []
    assert "#SBATCH --requeue" in lines


def test_a_task_of_the_array_runs_its_shard_and_gives_its_exit_code(tmp_path: Path) -> None:
    program = write_program(tmp_path / "program", f'echo "$@" > "{tmp_path}/called"; exit 3')

    done = subprocess.run(
        ["bash", SHARDS, "8", "eval", "demo", "--out", "runs/a b"],
        env=environment(tmp_path, program, SLURM_ARRAY_TASK_ID="5"),
    )

    assert (tmp_path / "called").read_text() == "eval demo --out runs/a b --shard 5/8\n"
    assert done.returncode == 3
    assert not (tmp_path / "scontrol").exists()


def test_a_job_runs_the_command_and_gives_its_exit_code(tmp_path: Path) -> None:
    program = write_program(tmp_path / "program", f'echo "$@" > "{tmp_path}/called"; exit 3')

    done = subprocess.run(
        ["bash", JOB, "finetune", "--policy", "pi0", "--out", "runs/a b"], env=environment(tmp_path, program)
    )

    assert (tmp_path / "called").read_text() == "finetune --policy pi0 --out runs/a b\n"
    assert done.returncode == 3
    assert not (tmp_path / "scontrol").exists()


@pytest.mark.parametrize(
    "command", [[SHARDS, "8", "eval", "demo"], [JOB, "finetune", "--policy", "pi0"]], ids=["shard", "job"]
)
def test_a_job_that_slurm_stops_ends_its_work_and_is_queued_again(
    tmp_path: Path, command: list[str | Path]
) -> None:
    body = (
        f'trap "touch {tmp_path}/ended; exit 143" TERM; touch {tmp_path}/begun; while :; do sleep 0.05; done'
    )
    program = write_program(tmp_path / "program", body)
    task = subprocess.Popen(["bash", *command], env=environment(tmp_path, program, SLURM_ARRAY_TASK_ID="5"))
    while not (tmp_path / "begun").exists():
        time.sleep(0.02)

    task.send_signal(signal.SIGTERM)  # as --signal=B:TERM does: to the script alone

    assert task.wait(30) == 143
    assert (tmp_path / "ended").exists()
    assert (tmp_path / "scontrol").read_text() == "requeue 77\n"


@pytest.mark.parametrize("delay_ms", range(0, 60, 6))
def test_a_job_that_is_stopped_while_it_starts_leaves_no_program_behind(
    tmp_path: Path, delay_ms: int
) -> None:
    pid = tmp_path / "pid"
    program = write_program(tmp_path / "program", f"echo $$ > {pid}; exec sleep 20")
    task = subprocess.Popen(["bash", JOB, "finetune"], env=environment(tmp_path, program))
    time.sleep(delay_ms / 1000)
    task.send_signal(signal.SIGTERM)

    assert task.wait(15) != 0

    if pid.exists() and pid.read_text().strip():
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.read_text()), 0)


def test_without_an_array_the_script_says_how_to_submit_it(tmp_path: Path) -> None:
    variables = environment(tmp_path, tmp_path / "program")
    variables.pop("SLURM_ARRAY_TASK_ID", None)

    done = subprocess.run(
        ["bash", SHARDS, "8", "eval", "demo"], env=variables, capture_output=True, text=True
    )

    assert done.returncode != 0
    assert "expected a job array: sbatch --array=1-8" in done.stderr


@pytest.mark.slow
def test_two_tasks_of_submitits_local_executor_merge_to_the_records_of_one_run(tmp_path: Path) -> None:
    program = write_program(tmp_path / "program", f'exec "{sys.executable}" -m vla_eval.cli "$@"')
    command = [
        *("eval", "--task", "RememberColor3-v0", "--policy", "random", "--episodes", "4", "--workers", "1"),
        *("--set", "simulator=fake", "--set", "env.horizon_steps=12", "--out", str(tmp_path / "run")),
    ]
    executor = submitit.LocalExecutor(folder=tmp_path / "submitit")
    executor.update_parameters(timeout_min=5)
    jobs = [
        executor.submit(
            CommandFunction(
                ["bash", str(SHARDS), "2", *command],
                env=environment(tmp_path, program, SLURM_ARRAY_TASK_ID=str(number)),
            )
        )
        for number in (1, 2)
    ]
    for job in jobs:
        job.result()
    subprocess.run([program, *command[:-1], str(tmp_path / "one")], check=True, capture_output=True)

    write_merged(merge_runs([tmp_path / f"run-shard-{n}-of-2" for n in (1, 2)]), tmp_path / "merged")

    one, merged = (
        sorted((tmp_path / name / "episodes.jsonl").read_bytes().splitlines()) for name in ("one", "merged")
    )
    assert merged == one
    assert len(read_run(tmp_path / "merged").records) == 4
