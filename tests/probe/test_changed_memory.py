"""Worlds with a changed memory, on the fake simulator, of a policy that remembers one candidate."""

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.memory_change import KINDS
from vla_eval.probe.interventions import INTERVENTIONS, plan_later, plan_probe
from vla_eval.probe.phases import fixed_phases, n_cue_frames_after
from vla_eval.probe.worlds import ProbeSettings
from vla_eval.results.cells import markdown_text
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import task_spec

pytestmark = pytest.mark.usefixtures("in_this_process")

N = 6
TASK = "RememberColor3-v0"  # cue to step 5, response from step 10
MODULE = """
from dataclasses import replace

import numpy as np

from vla_eval.core import ActionChunk
from vla_eval.oracles.hover import CUBES
from vla_eval.policies.controls.base import ScriptedPolicy, hold_rows


class OneCandidate(ScriptedPolicy):
    \"\"\"Remembers what is shown, as one number per candidate, and goes to the largest.\"\"\"

    privileged = True

    def __init__(self, context, keeps_first):
        super().__init__(context)
        self._keeps_first = keeps_first
        self._memories = {}
        self.spec = replace(self.spec, has_memory=True)

    def reset(self, episodes):
        super().reset(episodes)
        for episode in episodes:
            scores, n = np.zeros(3, np.float32), np.zeros(1, int)
            self._memories[episode.slot] = {"shown/scores": scores, "shown/n": n}

    def get_memory(self, slot):
        return {name: array.copy() for name, array in self._memories[slot].items()}

    def set_memory(self, slot, memory):
        self._memories[slot] = {name: array.copy() for name, array in memory.items()}

    def act(self, window):
        state, memory = self.privileged_state(window), self._memories[window.slot]
        scores = memory["shown/scores"]
        memory["shown/n"] += 1
        if state.shown_candidates and not (self._keeps_first and scores.any()):
            scores[:] = 0
            scores[state.shown_candidates[0]] = 1
        if state.phase != "response" or not scores.any():
            return ActionChunk(actions=hold_rows(state.gripper_width_m, self._n_actions))
        return ActionChunk(actions=CUBES.plan(state, int(scores.argmax()), self._n_actions))


def make(context):
    return OneCandidate(context, False)


def make_that_keeps_the_first(context):
    return OneCandidate(context, True)
"""


@pytest.fixture
def remembers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder with two such policies: `remembers` and `keeps_first`."""
    (tmp_path / "one_candidate_policy.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, made in (("remembers", "make"), ("keeps_first", "make_that_keeps_the_first")):
        adapter = f"one_candidate_policy:{made}"
        (tmp_path / f"{name}.yaml").write_text(
            json.dumps({"version": 1, "description": "d", "adapter": adapter})
        )
    return tmp_path


def probe(
    folder: Path, capsys: pytest.CaptureFixture[str], *arguments: str, out: str = "out"
) -> dict[str, Any]:
    capsys.readouterr()
    command = ["probe", "--task", TASK, "--episodes", str(N), "--out", str(folder / out), "--format", "json"]
    fake = ["--workers", "1", "--set", "simulator=fake", "--set", "env.horizon_steps=45"]
    assert main([*command, *arguments, *fake, "--n-action-steps", "5"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def row(found: dict[str, Any], intervention: str, level: int | str | None = None) -> dict[str, Any]:
    (own,) = [one for one in found["rows"] if (one["intervention"], one["level"]) == (intervention, level)]
    return own  # type: ignore[no-any-return]


def counts(row: dict[str, Any]) -> tuple[int, int]:
    """Return in how many episodes the cue is followed, and in how many nothing is touched."""
    return row["n_follows"], row["n_without_choice"]


def test_every_change_has_the_effect_that_follows_from_the_policy(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ("--policy", str(remembers / "remembers.yaml"), "--no-controls", "--probe", *KINDS)
    levels = ("--noise", "0", "1000", "--hold-at", "0", "5", "--age", "5", "40")
    found = probe(remembers, capsys, *policy, *levels)
    assert counts(row(found, "none")) == (N, 0)

    # The memory of the swapped world is put in at step 10: its candidate is taken, in every episode.
    put_in = row(found, "transplant", 1)
    assert (*counts(put_in), put_in["n_follows_memory"]) == (0, 0, N)
    # The cue is seen after what was left behind, and takes its place.
    left_behind = row(found, "carry_over")
    assert counts(left_behind) == (N, 0)
    assert left_behind["n_follows_memory"] == 0

    assert counts(row(found, "memory_noise", "0")) == (N, 0)
    # One of three by chance: all six right has a probability of 1/729.
    assert row(found, "memory_noise", "1000")["n_follows"] < N
    assert counts(row(found, "hold_memory", 0)) == (0, N)  # nothing is ever stored
    assert counts(row(found, "hold_memory", 5)) == (N, 0)
    assert counts(row(found, "stale_memory", 5)) == (N, 0)
    assert counts(row(found, "stale_memory", 40)) == (0, N)  # at step 40, what was known at step 0: nothing
    assert counts(row(found, "erase_memory", "shown/scores")) == (0, N)
    assert counts(row(found, "erase_memory", "shown/n")) == (N, 0)

    for unchanged in (("memory_noise", "0"), ("hold_memory", 5), ("erase_memory", "shown/n")):
        assert row(found, *unchanged)["p_value"] == 1.0
    assert not any("frames of the cue after" in note for note in found["notes"])  # K = 5, a delay of 5
    (sentence,) = found["sentences"]
    assert f"put in at the response in 0 of {N} (chance 2), and that memory in {N} of {N}" in sentence


def test_what_an_episode_leaves_behind_is_followed_by_who_keeps_the_first(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ("--policy", str(remembers / "keeps_first.yaml"), "--no-controls", "--probe", "carry_over")
    found = row(probe(remembers, capsys, *policy), "carry_over")
    assert found["n_follows_memory"] > 0
    # In episodes whose cue is that of the episode before, both are followed. The first has none before it.
    targets = [record.target for record in read_run(remembers / "out" / f"{TASK}_none").records]
    same = sum(one == other for one, other in itertools.pairwise(targets))
    assert found["follows_memory"] == 1.0
    assert found["n_follows_memory"] == N - 1 - same
    assert found["n_follows"] in (same, same + 1)


def test_the_world_and_what_is_before_the_change_are_equal_to_the_bit(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ("--policy", str(remembers / "remembers.yaml"), "--no-controls")
    probe(remembers, capsys, *policy, "--probe", "swap,transplant,memory_noise,hold_memory", "--noise", "0")
    runs = {
        name: {one.seed: one for one in read_run(remembers / "out" / f"{TASK}_{name}").records}
        for name in ("none", "swap_1", "transplant_1", "memory_noise_0", "hold_memory_5")
    }
    for name in ("memory_noise_0", "hold_memory_5"):
        assert runs[name] == runs["none"]
    for seed, drawn in runs["none"].items():
        swapped, put_in = runs["swap_1"][seed], runs["transplant_1"][seed]
        assert put_in.target == drawn.target
        # From the memory of the swapped world the very actions of the swapped world follow.
        assert put_in.trajectory_sha256 == swapped.trajectory_sha256


def test_records_are_the_same_for_any_number_of_workers_and_slots(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change = ["--set", 'memory_change={"kind": "transplant", "at_step": 10, "donor_env": {"swap_cue": 1}}']
    base = ["eval", "--task", TASK, "--policy", str(remembers / "remembers.yaml"), "--episodes", str(N)]
    base += ["--n-action-steps", "4", *change, "--set", "simulator=fake"]
    lines = []
    for workers, slots in ((1, 1), (2, 1), (1, 4), (2, 3)):
        out = remembers / f"w{workers}s{slots}"
        own = ["--workers", str(workers), "--set", f"slots_per_worker={slots}", "--out", str(out)]
        assert main([*base, *own]) == 0
        lines.append(sorted((out / "episodes.jsonl").read_text().splitlines()))
    capsys.readouterr()
    assert all(one == lines[0] for one in lines)


def test_policies_without_a_memory_get_a_row_that_says_so_and_are_not_run(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies = ("--policy", str(remembers / "remembers.yaml"), "body_memory")
    found = probe(remembers, capsys, *policies, "--probe", "erase_memory")
    for policy in ("body_memory", "oracle", "cue_blind"):
        own = [one["intervention"] for one in found["rows"] if one["policy"] == policy]
        assert own == ["none", "no memory"]
        (sentence,) = [line for line in found["sentences"] if line.startswith(policy)]
        assert sentence.endswith("keeps no memory that could be changed.")
    records = read_run(remembers / "out" / f"{TASK}_erase_memory_shown.n").records
    assert {record.policy for record in records} == {"remembers"}


def test_it_resumes_and_report_shows_the_same_rows(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--policy", str(remembers / "remembers.yaml"), "--probe", "transplant,erase_memory")
    first = probe(remembers, capsys, *arguments)
    files = {path: path.read_bytes() for path in (remembers / "out").glob("*/episodes.jsonl")}
    assert len(files) == 5  # none, swap, transplant, two parts
    assert probe(remembers, capsys, *arguments) == first
    assert {path: path.read_bytes() for path in files} == files
    assert main(["report", *map(str, sorted({path.parent for path in files}))]) == 0
    said = capsys.readouterr().out
    for sentence in first["sentences"]:
        assert markdown_text(sentence) in said


def test_who_remembers_is_not_guessed_where_no_episode_has_said_it(tmp_path: Path) -> None:
    config = EvalConfig(name="p", tasks=(TASK,), policies=("oracle",), simulator="fake")
    settings = ProbeSettings(probes=("memory_noise",), controls=False)
    first = plan_probe(config, settings)
    assert [world.intervention for world in first.worlds] == ["none"]
    assert not first.left_out
    command = ["eval", "--task", TASK, "--policy", "oracle", "--episodes", "1", "--set", "simulator=fake"]
    assert main([*command, "--workers", "1", "--out", str(tmp_path / first.worlds[0].config.name)]) == 0
    later = plan_later(config, settings, first, tmp_path, lambda policy: policy)
    assert not later.worlds
    assert (
        "oracle on RememberColor3-v0, worlds with a changed memory: whether it has one is not"
        in (later.left_out[0])
    )


def test_every_kind_of_change_is_an_intervention() -> None:
    assert {name for name, rule in INTERVENTIONS.items() if rule.of_memory} == set(KINDS)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--noise", "-1"), "--noise -1.0: expected a number ≥ 0."),
        (("--noise", "inf"), "--noise inf: expected a number ≥ 0."),
        (("--noise", "nan"), "--noise nan: expected a number ≥ 0."),
        (("--age", "0"), "--age 0: expected a whole number ≥ 1."),
        (("--hold-at", "-1"), "--hold-at -1: expected a whole number ≥ 0."),
        (("--set", "memory_change.kind=hold_memory"), "memory_change: a probe sets this field itself."),
    ],
)
def test_a_mistake_is_one_message(
    arguments: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "probe",
        "--task",
        TASK,
        "--policy",
        "oracle",
        "--out",
        str(tmp_path),
        "--set",
        "simulator=fake",
    ]
    assert main([*command, "--probe", "memory_noise", *arguments]) == 1
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("{kind: carry_over}", "expected a seed_start of 1 or more, found 0"),
        ("{kind: hold_memory, at_step: 60}", "memory_change.at_step=60: RememberColor3-v0: the episode ends"),
        ("{kind: hold}", "memory_change.kind"),
        ("{kind: erase_memory, part: shown/nn}", "expected one of shown/scores, shown/n, found 'shown/nn'"),
        ("{kind: transplant, donor_env: {swap: 1}}", "Did you mean 'swap_cue'?"),
    ],
)
def test_an_evaluation_refuses_what_cannot_be_changed(
    change: str, says: str, remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = remembers / "c.yaml"
    policy = str(remembers / "remembers.yaml")
    config.write_text(
        f"name: c\ntasks: [{TASK}]\npolicies: ['{policy}']\nepisodes: 2\nseed_start: 0\nsimulator: fake\n"
        f"workers: 1\nmemory_change: {change}\n"
    )
    code = main(["eval", str(config), "--out", str(remembers / "run")])
    said = capsys.readouterr()
    assert code in (1, 3)
    assert says in said.err + said.out


def test_two_shards_merged_have_the_rows_of_one_run(
    remembers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--policy", str(remembers / "remembers.yaml"), "oracle", "--no-controls")
    arguments += ("--probe", "transplant,carry_over")
    whole = probe(remembers, capsys, *arguments, out="whole")
    for shard in ("1/2", "2/2"):
        fake = ["--workers", "1", "--set", "simulator=fake", "--set", "env.horizon_steps=45"]
        command = ["probe", "--task", TASK, "--episodes", str(N), "--out", str(remembers / "parts"), *fake]
        assert main([*command, *arguments, "--n-action-steps", "5", "--shard", shard]) == 0
    folders = {path.name for path in remembers.glob("parts*/*")}
    assert f"{TASK}_transplant_1" in folders
    for name in sorted(folders):
        parts = sorted(str(path) for path in remembers.glob(f"parts*/{name}"))
        assert main(["merge", *parts, "--out", str(remembers / "merged" / name)]) == 0
    assert probe(remembers, capsys, *arguments, out="merged") == whole


@pytest.mark.parametrize(
    ("task", "k", "n_frames"),
    [
        # Cue at steps 0 to 4, response from 10 on: the inference before that of step 10 (16) is at 5 (8).
        *(("RememberColor3-v0", k, 0) for k in (1, 5, 8)),
        ("RememberColor3-v0", 10, 4),  # 0, then 10: frames 1 to 4 come with it
        ("RememberColor3-v0", 12, 4),
        # Cue at steps 0 to 4, response from 5 on.
        ("ShellGameTouch-v0", 1, 0),
        ("ShellGameTouch-v0", 4, 0),  # 4, then 8
        ("ShellGameTouch-v0", 5, 4),
        ("ShellGameTouch-v0", 8, 4),  # 0, then 8
        ("ShellGameTouch-v0", 2, 0),  # 4, then 6
        ("ShellGameTouch-v0", 3, 1),  # 3, then 6: frame 4
    ],
)
def test_frames_of_the_cue_that_are_shown_after_the_change_are_counted(
    task: str, k: int, n_frames: int
) -> None:
    assert n_cue_frames_after(fixed_phases(task_spec(task), {}), k) == n_frames
