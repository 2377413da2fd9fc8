"""What a command has started ends with it, within 2 s, even if the command is killed by SIGKILL."""

import itertools
import secrets
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.cli.every_verb import (
    COMMANDS,
    FAKE,
    FINETUNE,
    ROOT,
    TASK,
    TRAIN_AGENT,
    command_line,
    environment_of,
)
from tests.waiting import wait_until

MARK = "MIKASA_A_TEST_MARKS"
WITHIN_S = 2.0
MOMENTS_S = {"as its first child starts": 0.0, "while children import": 1.5, "in mid-work": 7.0}
CHILDREN = (" -c ", " -m ", "rerun_cli")
"""In the command lines of Python's helpers, of our own, and of the viewer."""
MANY = f"--episodes 2000 {FAKE}"
LONG = {
    "record": f"record --task {TASK} {MANY} --out {{W}}/long",
    "replay": "replay {W}/data --workers 2",
    "eval": f"eval --task {TASK} --policy oracle {MANY} --out {{W}}/run",
    "eval --serve": f"eval --task {TASK} --policy oracle --serve {MANY} --out {{W}}/served",
    "audit": f"audit --task {TASK} --control hold --protocol paper {MANY} --out {{W}}/audit",
    "probe": f"probe --task {TASK} --policy cue_blind {MANY} --out {{W}}/probe",
    "finetune": f"{FINETUNE} --steps 100000 --out {{W}}/trained",
    "train-agent": f"{TRAIN_AGENT} --steps 1000000 --workers 2 --out {{W}}/agent",
    "bench --serve": "bench --serve --sessions 2 --seconds 60",
    "doctor": "doctor",
    "view": f"view {{W}}/data/{TASK} --episode 0 --web",
}


def children(mark: str) -> int:
    """Return how many of our children there are; git, which is asked for the version, does not count."""
    return sum(any(word in command for word in CHILDREN) for command in marked(mark).values())


def marked(mark: str) -> dict[int, str]:
    """Return process id -> command line of each living process that was started with the mark."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():  # empty once it has ended
                found[int(folder.name)] = (
                    (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:150]
                )
        except OSError:  # it has ended
            continue
    return found


@pytest.fixture(scope="module")
def recorded_work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("killed")
    command = COMMANDS["record"].replace("--episodes 2", "--episodes 8")
    subprocess.run(
        command_line(command, work), cwd=work, env=environment_of(work), check=True, capture_output=True
    )
    return work


SOON, LATER, AT_WORK = MOMENTS_S
IN_EVERY_RUN = {("record", SOON), ("record", LATER), ("eval --serve", AT_WORK)}


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        pytest.param(*case, marks=() if case in IN_EVERY_RUN else pytest.mark.slow)
        for case in itertools.product(LONG, MOMENTS_S)
    ],
)
def test_no_process_outlives_a_killed_command(
    name: str, moment: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    mark = secrets.token_hex(8)
    if "{W}/data" in LONG[name]:  # recording for those that do not read it would take longer than they do
        (tmp_path / "data").symlink_to(request.getfixturevalue("recorded_work") / "data")
    with subprocess.Popen(
        command_line(LONG[name], tmp_path),
        cwd=ROOT,
        env=environment_of(tmp_path, **{MARK: mark}),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        wait_until(lambda: children(mark) or process.poll() is not None)
        assert process.poll() is None, "it has ended before it started a child"
        time.sleep(MOMENTS_S[moment])
        process.send_signal(signal.SIGKILL)
    time.sleep(WITHIN_S)
    assert marked(mark) == {}
