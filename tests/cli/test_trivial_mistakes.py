"""A mistyped name or a missing folder is reported at once: before torch, lerobot or a simulator is loaded."""

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.cli.every_verb import COMMANDS, environment_of, verb_of

TASK = "RememberColor3-v0"
FAKE = "--set simulator=fake"
# A typo, a wrong type, and what a task's arguments cannot be together (`test_arguments_together`).
WRONG_ENV = {
    "--set env.delay_step=20": "Did you mean 'delay_steps'?",
    "--set env.delay_steps=long": "delay_steps",
    "--set env.horizon_steps=8": "no step is left for the choice",
    "--set env.control_mode=pd_ee": "Did you mean 'pd_ee_",
    "--set env.cluter=3": "Did you mean 'clutter'?",
    "--set env.clutter=13": "expected 0 to 12",
    "--set env.goal_threshold_m=5 --set env.clutter=1": "expected at most 0",
    "--set env.robot=so10": "Did you mean 'so100'",
    "--set env.robot=so100 --set env.control_mode=pd_ee_pose": "this arm takes pd_joint_pos",
}
WRONG_MESHES = {
    "--set env.meshes=nowhere": "expected a folder of meshes",
    "--set env.meshes=empty": "no mesh in it",
    "--set env.mesh_scale=0.001": "without meshes",
    "--set env.mesh=empty": "Did you mean 'meshes'?",
}
HEAVY = (*("torch", "lerobot", "transformers", "datasets", "mani_skill", "sapien", "cv2", "rerun"),)
MOST_CPU_SECONDS = 2.0
# Verb -> command lines, each with a word that the message must have.
MISTAKES: dict[str, dict[str, str]] = {
    "init": {"init own": "ends in .yaml", "init nowhere/own.yaml": "no folder 'nowhere'"},
    "eval": {
        "eval nowhere": "nowhere",
        "eval nowhere.yaml": "nowhere.yaml: there is no such file or folder in ",
        f"eval --task {TASK} --policy mine= {FAKE}": "found empty text",
        f"eval --task {TASK} --policy mine=empty,,empty {FAKE}": "found empty text",
        f"eval --task {TASK} --policy mine:{TASK}= {FAKE}": "found empty text",
        f"eval --task RememberColour3-v0 --policy oracle {FAKE}": "RememberColour3-v0",
        f"eval --task {TASK} --policy orcale {FAKE}": "Did you mean 'oracle'",
        f"eval --task {TASK} --policy runs/nowhere {FAKE}": "runs/nowhere",
        f"eval --task {TASK} --policy empty {FAKE}": "empty",
        f"eval --task {TASK} --policy oracle --protocol paper_vl {FAKE}": "Did you mean 'paper_vla'",
        f"eval --task {TASK} --policy smolvla {FAKE}": "mikasa-vla checkpoint fetch smolvla_base",
        f"eval --task {TASK} --policy oracle --set env.swap_cue=7": "expected 0 to 2, 0 for no swap",
        f"eval --task {TASK} --policy act --dry-run": "has no weights",
        f"eval --task {TASK} --policy memory_color3 --n-action-steps 4 16 --dry-run": "chunks of 8 actions",
        **{f"eval --task {TASK} --policy oracle --dry-run {env}": said for env, said in WRONG_ENV.items()},
        **{
            f"eval --task RememberObject3-v0 --policy oracle --dry-run {env}": said
            for env, said in WRONG_MESHES.items()
        },
    },
    "report": {
        "report runs/nowhere": "runs/nowhere",
        "report empty": "empty",
        "report --imported nothing.json": "there is no such file",
    },
    "merge": {"merge runs/nowhere --out new": "runs/nowhere"},
    "compare": {"compare runs/nowhere": "runs/nowhere"},
    "reproduce": {
        "reproduce runs/nowhere --policy oracle": "runs/nowhere",
        f"reproduce 9/10 --policy oracle --task RememberColour3-v0 {FAKE}": "RememberColour3-v0",
        "reproduce 100/100 --policy oracle": "of which task",
        f"reproduce 100/100 --policy orcale --task {TASK} {FAKE}": "Did you mean 'oracle'",
    },
    "passport": {
        "passport runs/nowhere": "runs/nowhere",
        "passport empty": "empty",
        "passport GPM": "Did you mean 'GMP'",
        "passport OpenVLA": "Name one of OpenVLA K=4, OpenVLA K=8",
    },
    "check": {
        "check orcale": "Did you mean 'oracle'",
        "check runs/nowhere": "runs/nowhere",
        "check empty": "empty",
        "check oracle --task RememberColour3-v0": "RememberColour3-v0",
        "check smolvla": "has no weights",
    },
    "audit": {
        f"audit --task RememberColour3-v0 {FAKE}": "RememberColour3-v0",
        f"audit --task {TASK} --control hodl {FAKE}": "hodl",
        f"audit --task {TASK} --set env.delay_step=20": "an audit sets this field itself",
    },
    "probe": {
        f"probe --task RememberColour3-v0 --policy oracle {FAKE}": "RememberColour3-v0",
        f"probe --task {TASK} --policy orcale {FAKE}": "Did you mean 'oracle'",
        f"probe --task {TASK} --policy runs/nowhere {FAKE}": "runs/nowhere",
        "probe nowhere": "nowhere",
        f"probe --task {TASK} --policy act {FAKE}": "has no weights",
        **{f"probe --task {TASK} --policy oracle {env}": said for env, said in WRONG_ENV.items()},
    },
    "real": {
        "real --robot simulated_so10 --policy oracle": "Did you mean 'simulated_so100'",
        "real --robot nowhere.yaml --policy oracle": "nowhere.yaml",
        "real --robot simulated_so100": "--policy is missing",
        "real --policy oracle": "--robot is missing",
        "real --robot simulated_so100 --policy orcale": "Did you mean 'oracle'",
        "real --robot simulated_so100 --policy oracle --stage CubeShuffled": "Did you mean 'CubesShuffled'",
        "real --robot simulated_so100 --policy oracle --operator keys": "Leave --operator out",
        "real --robot simulated_so100 --policy oracle --rehearse cabel@1": "Did you mean 'cable'",
        "real --robot simulated_so100 --policy oracle --rehearse cable@91": "from 1 to 90",
        "real recrod --robot simulated_so100": "Did you mean 'record'",
        "real record": "--robot is missing",
        "real record --robot simulated_so10": "Did you mean 'simulated_so100'",
        "real record --robot simulated_so100 --policy oracle": "--policy is for `mikasa-vla real evaluate`",
        "real --robot simulated_so100 --policy oracle --keep all": "--keep is for `mikasa-vla real record`",
        "real record --robot simulated_so100 --n-action-steps 0": "--n-action-steps is for",
        "real record --robot simulated_so100 --teleop lerobot": "Leave --teleop out",
        "real record --robot simulated_so100 --keep some": "successes",
        "real record --robot simulated_so100 --episodes 0": "--episodes",
    },
    "view": {"view runs/nowhere --print": "runs/nowhere", "view empty --print": "empty"},
    "record": {
        "record nowhere": "nowhere",
        f"record --task RememberColour3-v0 {FAKE}": "RememberColour3-v0",
        f"record --task {TASK} --set env.swap_cue=7": "expected 0 to 2, 0 for no swap",
        **{f"record --task {TASK} {env}": said for env, said in WRONG_ENV.items()},
    },
    "replay": {"replay data/nowhere": "data/nowhere", "replay empty": "empty"},
    "dataset": {
        "dataset convert data/nowhere --to npz --out new": "data/nowhere",
        "dataset convert data/nowhere --control-mode pd_ee_pose --out new": "data/nowhere",
        "dataset mix data/nowhere data/elsewhere --out new": "data/nowhere",
        "dataset check data/nowhere": "data/nowhere",
        "dataset adopt data/nowhere": "data/nowhere",
        "dataset adopt data/nowhere --task RememberColour3-v0": "RememberColour3-v0",
        "dataset check-leak data/nowhere": "data/nowhere",
        "dataset card data/nowhere": "data/nowhere",
        "dataset push data/nowhere nobody/nothing": "data/nowhere",
        "dataset push empty nobody/nothing": "empty",
    },
    "finetune": {
        "finetune nowhere": "nowhere",
        "finetune paper_vla_table": "data/",
        "finetune --policy acct --dataset data/nowhere": "Did you mean 'act'",
        "finetune --policy act --dataset data/nowhere": "data/nowhere",
        "finetune --policy act --dataset empty": "empty",
        "finetune --policy act --dataset empty --dry-run": "empty",
        "finetune --policy runs/nowhere --dataset empty": "runs/nowhere",
        "finetune --policy empty --dataset empty": "empty",
        "finetune --policy smolvla --dataset data/nowhere --base-checkpoint nowhere": "nowhere",
    },
    "train-agent": {
        "train-agent nowhere": "nowhere",
        f"train-agent --algorithm ppoo --task {TASK}": "Did you mean 'ppo'",
        f"train-agent --algorithm tdmpc2 --task {TASK}": "no package has it",
        "train-agent --algorithm ppo": "--task is missing",
        "train-agent --algorithm ppo --task RememberColour3-v0": "RememberColour3-v0",
        f"train-agent --policy act --task {TASK}": "no section `train_agent`",
        f"train-agent --algorithm ppo --task {TASK} --observation stat": "expected 'state'",
        f"train-agent --algorithm ppo --task {TASK} --set env.control_mode=pd_jont_pos": "pd_joint_pos",
        f"train-agent --algorithm ppo --task {TASK} --set gama=0.9": "gama",
    },
    "checkpoint": {
        "checkpoint verify runs/nowhere": "runs/nowhere",
        "checkpoint verify empty": "empty",
        "checkpoint fetch smolvla_bsae": "Did you mean 'smolvla_base'",
        "checkpoint rehearse acct": "Did you mean 'act'",
        "checkpoint rehearse empty": "empty",
        "checkpoint rehearse oracle": "finetune",
        "checkpoint merge runs/nowhere --out new": "runs/nowhere",
        "checkpoint convert-octo runs/nowhere --size small --out new": "runs/nowhere",
        "checkpoint convert-openvla runs/nowhere --out new": "runs/nowhere",
        "checkpoint convert-spatialvla runs/nowhere --out new": "runs/nowhere",
    },
    "serve": {
        "serve --policy orcale": "Did you mean 'oracle'",
        "serve --policy random --chunking-mode rct": "Did you mean 'rtc'",
        "serve --policy random --set delay=3": "expected fields of rtc, with --chunking-mode rtc",
        "serve --policy random --chunking-mode rtc": "does not read what is committed",
        "serve --policy runs/nowhere": "runs/nowhere",
        "serve --policy empty": "empty",
        "serve --policy random --task RememberColour3-v0": "RememberColour3-v0",
    },
    "list": {"list task": "tasks"},
    "show": {"show RememberColour3-v0": "Did you mean 'RememberColor3-v0'"},
    "doctor": {"doctor --jsn": "Did you mean '--json'"},
    "bench": {
        "bench --task RememberColour3-v0": "RememberColour3-v0",
        "bench --loader data/nowhere": "data/nowhere",
        "bench --serve orcale": "Did you mean 'oracle'",
        "bench --serve runs/nowhere": "runs/nowhere",
        "bench --against-official nowhere": "mikasa-robo-suite at nowhere",
    },
    "completion": {"completion bsh": "bash"},
}
EACH_IN_A_FORK = """
import io, json, os, resource, sys
import vla_eval.cli.main as cli
import importlib
import numpy  # which most commands load: once is enough
for verb in cli.VERBS:
    importlib.import_module(f"vla_eval.cli.{verb.replace('-', '_')}")  # what `mikasa-vla --help` loads
heavy, commands = json.loads(sys.argv[1]), json.loads(sys.argv[2])
for command in commands:
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        said = io.StringIO()
        sys.stderr = sys.stdout = said
        sys.argv = ["mikasa-vla", *command.split()]
        try:
            code = cli.main(command.split())
        except SystemExit as exc:
            code = exc.code
        used = resource.getrusage(resource.RUSAGE_SELF)
        loaded = [name for name in heavy if name in sys.modules]
        outcome = (code, said.getvalue(), loaded, used.ru_utime + used.ru_stime)
        os.write(writer, json.dumps(outcome).encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        print(json.dumps([command, *json.loads(file.read() or '[null, "nothing", [], 0]')]))
    os.waitpid(child, 0)
"""
COMMAND_LINES = [line for lines in MISTAKES.values() for line in lines]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Each command line, run in a fork of a process that has loaded no more than all verbs do."""
    work = tmp_path_factory.mktemp("mistakes")
    (work / "empty").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", EACH_IN_A_FORK, json.dumps(HEAVY), json.dumps(COMMAND_LINES)],
        capture_output=True,
        check=True,
        cwd=work,
        env=environment_of(work),
        text=True,
        timeout=600,
    )
    return {found[0]: found[1:] for found in map(json.loads, done.stdout.splitlines())}


def test_every_verb_has_a_trivial_mistake() -> None:
    assert set(MISTAKES) == {verb_of(name)[0] for name in COMMANDS}


def test_each_trivial_mistake_is_reported_before_anything_heavy_is_loaded(outcomes: dict[str, Any]) -> None:
    """All in one test: each process that had one of them would run all commands."""
    wrong = []
    for line, word in (pair for lines in MISTAKES.values() for pair in lines.items()):
        code, message, loaded, seconds = outcomes[line]
        if not (code == 1 and word in message and loaded == [] and seconds < MOST_CPU_SECONDS):
            wrong.append(f"{line}: exit {code}, {seconds} s, loaded {loaded}: {message}")
    assert not wrong, "\n".join(wrong)
