"""A report quotes the shipped audit for the tasks that it shows, and for nothing that was not audited."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.results.stored_runs import episodes, stored
from vla_eval.audit.audit_text import render_audit
from vla_eval.audit.stored_frames import render_stored_frames
from vla_eval.audit.verdicts import verdict
from vla_eval.errors import ReportError
from vla_eval.results import shipped_audit as audited
from vla_eval.results.report import audit_notes
from vla_eval.results.shipped_audit import (
    INTEGRATED,
    NEWEST,
    NOT_AUDITED,
    ONE,
    OTHER_VERDICTS,
    ROADS,
    SEVERAL,
    STRICT,
    UNREAD,
    Counts,
    StoredFrames,
    TaskAudit,
    protocol_of,
    shipped_audits,
    stored_frames,
)
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import OFFICIAL_TASKS, SUITES, TASKS, task_spec

COLOR, SHELL = "RememberColor3-v0", "ShellGameTouch-v0"
LONG, TIMED = "mikasa_vla/RememberColor3-Long-VLA-v0", "mikasa_vla/TimedTransferEasy-VLA-v0"
DOCS = Path(__file__).parents[2] / "docs"


def audit(task: str, *words: str, protocol: audited.AuditProtocol = "paper", version: int = 1) -> TaskAudit:
    won = Counts(n_episodes=30, success_once=30, success_at_end=30, first_choice=30, chance=0.3)
    return TaskAudit(
        task=task,
        version=version,
        protocol=protocol,
        chance=0.3,
        counts={"oracle": won},
        verdict=words,
        n_errors=0,
    )


@pytest.fixture(autouse=True)
def _shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An audit of three rows ships, as the command writes it, and one of two official tasks."""
    rows = [
        audit(COLOR, "can be toured", "body can store the cue"),
        audit(COLOR, "needs memory", protocol="strict"),
        audit(SHELL, "can be toured", "won by staying at the cue", version=99),
    ]
    monkeypatch.setattr(audited, "FILE", tmp_path / "shipped_audit.json")
    audited.FILE.write_text(render_audit(rows, "json"), encoding="utf-8")
    monkeypatch.setattr(audited, "OBJECTS_FILE", tmp_path / "objects_audit.json")
    audited.OBJECTS_FILE.write_text("[]", encoding="utf-8")
    monkeypatch.setattr(audited, "OFFICIAL_FILE", tmp_path / "official_audit.json")
    official = [
        audit(LONG, "won by staying at the cue", protocol="official"),
        audit(TIMED, NOT_AUDITED, protocol="official"),
    ]
    audited.OFFICIAL_FILE.write_text(render_audit(official, "json"), encoding="utf-8")
    monkeypatch.setattr(audited, "STORED_FRAMES_FILE", tmp_path / "stored_frames.json")
    audited.STORED_FRAMES_FILE.write_text("[]", encoding="utf-8")
    _read_again()
    yield
    _read_again()


def _read_again() -> None:
    shipped_audits.cache_clear()
    stored_frames.cache_clear()


def frames(task: str, verdict: str, *, version: int = 1, asked: audited.Asked = "item") -> StoredFrames:
    return StoredFrames(
        task=task,
        version=version,
        asked=asked,
        n_episodes=80,
        chance=0.3,
        newest=24,
        first=80,
        cue_end=80,
        best=80,
        best_step=0,
        all=80,
        n_frames=1,
        probes=verdict,
        verdict=verdict,
    )


def run_of(task: str, **config: object) -> StoredRun:
    return stored(episodes("oracle", "+", task=task), **config)


def test_a_run_by_the_papers_rule_is_told_by_which_roads_its_task_can_be_won() -> None:
    (note,) = audit_notes([run_of(COLOR), run_of(COLOR, env={})])
    assert note == (
        f"can be won without memory: {COLOR} by touching one candidate after another, or by storing the cue "
        "in the gripper (audit under the paper's rule, 30 episodes per control: docs/audit.md)."
    )


def test_a_note_says_of_which_tasks_one_frame_has_to_be_stored_and_of_which_several() -> None:
    seq, chain = "SeqOfColors3-v0", "ChainOfColors3-v0"
    shipped = [audit(task, "needs memory") for task in (COLOR, seq, chain)] + [audit(SHELL, "can be toured")]
    audited.FILE.write_text(render_audit(shipped, "json"), encoding="utf-8")
    rows = [
        frames(COLOR, ONE),
        frames(SHELL, UNREAD),
        frames(seq, SEVERAL, asked="set"),
        frames(seq, SEVERAL, asked="order"),
        frames(chain, SEVERAL, version=9),  # another task than the audited one
    ]
    audited.STORED_FRAMES_FILE.write_text(render_stored_frames(rows, "json"), encoding="utf-8")
    _read_again()
    (note,) = audit_notes([run_of(task) for task in (COLOR, SHELL, seq, chain)])
    assert (
        f"; one stored frame is enough to remember the cue of {COLOR}; it takes several stored frames to "
        f"remember the cue of {seq} (audit" in note
    )


def test_every_verdict_of_an_audit_has_words_for_readers() -> None:
    said = {word for one in shipped_audits().values() for word in one.verdict}
    assert said <= {*ROADS, *OTHER_VERDICTS}


def test_a_run_of_official_tasks_gets_their_audit() -> None:
    runs = [run_of(LONG, env={"mug": "stand_in"}), run_of(TIMED)]
    (note,) = audit_notes(runs)
    assert note == (
        f"can be won without memory: {LONG} by staying where the cue was shown; not audited, for lack of a "
        f"scripted control: {TIMED} (audit under the official rule, 30 episodes per control: "
        "docs/audit_official.md)."
    )
    assert audit_notes([run_of(LONG, env={"horizon_steps": 100})]) == []


def test_a_strict_run_gets_the_strict_verdict() -> None:
    (note,) = audit_notes([run_of(COLOR, env={"freeze_until_choice": True, "strict_choice": True})])
    assert note.startswith(f"no shortcut found: {COLOR} (audit under the strict rule")


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        ({}, "paper"),
        (dict(STRICT), "strict"),
        ({"freeze_until_choice": True, "strict_choice": True}, "strict"),
        ({"freeze_until_choice": True}, None),
        ({"freeze_until_choice": True, "phase_gate_success": True}, None),
        ({**STRICT, "delay_steps": 20}, None),
        ({**STRICT, "strict_choice": False}, None),
        ({"delay_steps": 20}, None),
    ],
)
def test_only_the_very_arguments_of_the_strict_rule_are_the_strict_rule(
    env: dict[str, object], expected: str | None
) -> None:
    assert protocol_of(env) == expected


def test_nothing_is_said_of_what_was_not_audited() -> None:
    others = [
        run_of(COLOR, env={"delay_steps": 20}),
        run_of(COLOR, simulator="fake"),
        run_of(SHELL),  # audited in another version
        run_of("RememberColor5-v0"),
    ]
    assert audit_notes(others) == []


def test_the_audit_that_ships_is_of_present_tasks_and_in_the_docs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    shipped_audits.cache_clear()
    audits = list(shipped_audits().values())
    official = [one for one in audits if one.protocol == "official"]
    ours = [one for one in audits if one.protocol != "official"]
    assert {one.task for one in ours} <= set(TASKS)
    assert {one.task for one in official} <= set(SUITES["mikasa_vla_90"])
    for one in audits:
        scripted = bool(task_spec(one.task).oracle)
        assert verdict(one.counts, one.chance, scripted=scripted) == one.verdict  # nobody has edited it
    things = [one for one in ours if one.task in SUITES["objects"]]
    paper = [one for one in ours if one.task in SUITES["paper"]]
    for name, shown in (("audit", paper), ("audit", things), ("audit_official", official)):
        assert render_audit(shown, "markdown") in (DOCS / f"{name}.md").read_text(encoding="utf-8")


def test_the_stored_frames_that_ship_are_of_present_tasks_and_in_the_docs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    _read_again()
    pages = {name: (DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("audit", "audit_official")}
    assert set(stored_frames()) <= {*TASKS, *OFFICIAL_TASKS}
    for one in stored_frames().values():
        spec = task_spec(one.task)
        expected = ONE if one.n_frames == 1 else SEVERAL  # what the simulator has in view
        expected = one.probes if one.probes in (SEVERAL, NEWEST) else expected
        assert one.verdict == (INTEGRATED if spec.is_tracked else expected)
        assert (one.n_frames is None) == spec.is_tracked
        n_frames = "—" if one.n_frames is None else one.n_frames
        counts = (one.newest, one.first, one.cue_end, one.best, one.all, n_frames)
        name = one.task.rpartition("/")[2]
        cells = " | ".join(map(str, (name, one.asked, f"{one.chance:.2f}", *counts)))
        page = pages["audit_official" if spec.is_official else "audit"]
        assert f"| {cells} | {one.probes} | {one.verdict} |" in page


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ("[{}]", r"expected the shipped audit, found no field 'audits.0.task'"),
        ("[", "expected the shipped audit"),
        ('{"a": 1, "a": 2}', "the field 'a' twice"),
        ("null", "audits None .expected a list"),
    ],
)
def test_a_damaged_audit_is_named(found: str, message: str) -> None:
    audited.FILE.write_text(found, encoding="utf-8")
    with pytest.raises(ReportError, match=message):
        shipped_audits()
