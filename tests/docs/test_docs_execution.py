"""Each command of README and docs is executed, small, on stand-ins for what it names; or it is listed.

`eval` and `finetune` are dry runs, which refuse what the run would refuse. Other verbs do all of it on the
fake simulator, in this process.
"""

import glob
import itertools
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.docs import stand_ins
from tests.docs.test_docs_commands import ALL, ROOT
from tests.serving.served_policies import Running
from vla_eval.cli.main import main
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.server import ServerOptions

NOT_EXECUTED: Mapping[str, str] = {
    r"audit --suite .*|audit": "oracles of all tasks, which the fake simulator has not; tests/audit",
    r"bench --against-official official.*": "the official package; tests/bench/test_official_bench.py",
    r"bench( --against-official| --serve.*)?": "measures this machine; tests/bench",
    r"checkpoint convert-.*": "original weights; tests/models/octo/test_octo_convert.py",
    r"checkpoint fetch .*|.*hub:.*": "the Hub; tests/checkpoints/test_fetching.py",
    r"checkpoint merge .*": "an adapter of a trained VLA; tests/training/test_prompted_to_eval.py",
    r"checkpoint rehearse .*": "a network of 450 million parameters; tests/testing/test_rehearsal.py",
    r"dataset convert remember_.*": "the official demonstrations; tests/data/test_data_convert.py",
    r"dataset convert .* --control-mode .*": "joints; tests/data/test_control_conversion.py",
    r"dataset check-leak data/npz/.*": "states of the real simulator; tests/data/test_leak.py",
    r"dataset mix data/many/.*": "ten tasks, some of which the fake simulator has not; two are mixed here",
    r"dataset (push|pull) .*": "the Hub; tests/data/test_hub.py",
    r"doctor --cluster .*|.* --cluster .*": "Ray; tests/evaluation/test_evaluate_on_cluster.py",
    r"(eval|serve) .*compile.*": "a network without a memory; tests/policies/test_compiling.py",
    r"eval .*--json-progress .*": "an open file descriptor; tests/cli/test_json_progress.py",
    r"eval paper_vla_table --tiny .*": "minutes; tests/evaluation/test_tiny_model_table.py",
    r"eval .* remote_openpi@.*|eval .*ws://.* --set env.control_mode=.*|eval --task mikasa_vla/.*ws://.*": (
        "a server of openpi with actions of joints; tests/docs/test_docs_released_policies.py"
    ),
    r"finetune .*base.checkpoint[ =]runs/decisions.*": (
        "a trained sequence policy; tests/training/test_sequence_to_eval.py"
    ),
    r".*eval_info.json.*": "results of another program; tests/results/test_imported.py",
    r"merge .*-of-8.*": "eight shards; those of two are put together here",
    r"probe .* --probe appearance .*": "what the fake simulator does not draw; tests/probe/test_probe.py",
    r"probe probe|probe probe --set .*": "all changes of all tasks; tests/probe",
    r"record .*--set env.control_mode=.*|record offline_rl .*|record --task real_twin/.*": (
        "joints and arms, which the fake simulator has not; tests/data/test_record_maniskill.py"
    ),
    r"eval .*--delay-trace .*": "a run whose delays were measured; tests/evaluation/test_delays.py",
    r"train-agent .*|eval .* runs/(bit|rc3) .*|eval runs/(memory|base_table|ladder_\w+)/.*": (
        "trained agents; tests/agents/test_agents_as_policies.py"
    ),
    r"audit --stored-frames.*": "twenty episodes at least; tests/audit/test_stored_frames.py",
    r"real (record )?--robot bench_3.yaml .*": "an arm; tests/envs/test_robot_env.py, tests/real",
    r"dataset (check|adopt) data/so101": "a download; tests/data/test_arm_datasets.py",
    r"real record .*|(real|finetune) .*act_shuffled.*|real .*recurrent=runs/rec .*": (
        "a policy trained for the arm: minutes; tests/real/test_recorded_to_real.py"
    ),
    r"real .*--rehearse .*": "faults, which end with 3; tests/real/test_real_command.py",
    r"report .* --card .*": "a card of a checkpoint; tests/results/test_model_card.py",
    r"reproduce .*": "up to hundreds of episodes; tests/cli/test_reproduce.py",
    r"serve --policy pi05 .*": "fetched weights and a GPU; tests/cli/test_serve.py",
}
"""Command -> what it needs that is not here, and which tests run the like."""
SLOW = (
    r"audit .*strict.*|check (DIR --task|my).*|dataset convert data/npz.*|merge .*|record .*--shard .*"
    r"|finetune (paper|ablations).*|finetune --policy (openvla|pi0|spatialvla).*|report .*--html.*"
    r"|bench --loader.*|probe .*(=runs/|memory_|grid|probe --).*"
)
FINDINGS = {"dataset check data/foreign"}
"""Commands that say by their exit code that something has to be changed: here the commands of the gripper."""
SMALL: Mapping[str, tuple[str, ...]] = {
    "audit": stand_ins.SMALL[:4],
    "bench": ("--batches", "1", "--repeats", "1"),
    "eval": ("--dry-run",),
    "finetune": ("--dry-run",),
    "probe": stand_ins.SMALL,
    "record": (*stand_ins.SMALL, "--task", stand_ins.DEFAULT_TASK),
    "view": ("--print",),
}
"""Verb -> what makes its commands small."""
OURS = list(dict.fromkeys(shlex.join(one.words[1:]) for one in ALL if one.program == "mikasa-vla"))


def why_not(command: str) -> str | None:
    """Return why a command is not executed here; None: it is."""
    return next((why for pattern, why in NOT_EXECUTED.items() if re.fullmatch(pattern, command)), None)


def small(command: str) -> tuple[str, ...]:
    """Return the words of a command, small: on one task, without a viewer."""
    text = re.sub(r"(?<=^record )(.*)--task( [\w/-]+-v0)+", r"\1", command).replace(" --web", "")
    words = tuple(shlex.split(text))
    more = ("--episodes", "20") if words[0] == "record" and "--shard" in words else ()
    return (*words, *SMALL.get(words[0], ()), *more)


ONCE = {re.sub(r"(?<=^record )(.*)--out \S+", r"\1", shlex.join(small(one))): one for one in OURS}
"""Recordings that differ in their folder alone are made once."""
EXECUTED = [
    pytest.param(one, marks=[pytest.mark.slow] if re.fullmatch(SLOW, one) else [], id=one)
    for one in ONCE.values()
    if why_not(one) is None
]


def test_what_is_listed_is_in_the_docs_and_names_a_test_that_exists() -> None:
    assert [one for one in (*NOT_EXECUTED, SLOW) if not any(re.fullmatch(one, cmd) for cmd in OURS)] == []
    for why in NOT_EXECUTED.values():
        if "tests/" in why:
            assert (ROOT / "tests" / why.rpartition("tests/")[2]).exists(), why
    assert len(EXECUTED) > len(ONCE) * 3 / 4


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Serve a shipped policy; return the port."""
    hosted = host_policy(HostOptions(policy="memory_color3", max_batch=1))
    running = Running(hosted, ServerOptions(host="127.0.0.1", port=0))
    yield str(running.port)
    running.stop()
    running.wait()


@pytest.fixture(scope="module", autouse=True)
def _serves_no_one() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vla_eval.serving.server.run_server", lambda *_, ready, **__: ready(8000, None))
        yield


@pytest.mark.sampled(6)
@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("command", EXECUTED)
def test_a_command_of_the_docs_is_executed(
    command: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    words = small(command)
    if "ws://" in command:
        names = itertools.cycle(("127.0.0.1", "localhost"))  # two names of one server
        port = request.getfixturevalue("server")
        words = tuple(re.sub(r"(?<=ws://)[\w.-]+:\d+", lambda _: f"{next(names)}:{port}", w) for w in words)
    for path in stand_ins.missing(words):
        stand_ins.put(words[0], path)
    capsys.readouterr()
    code = main([path for word in words for path in sorted(glob.glob(word)) or [word]])  # as a shell does it
    said = capsys.readouterr()
    assert code == (command in FINDINGS), said.err
    assert said.out
