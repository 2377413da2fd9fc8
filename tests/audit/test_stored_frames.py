"""How much has to be stored: verdicts from made-up answers, and the audit on the fake simulator."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.audit.stored_frames import ONE, SEVERAL, UNREAD, _best, _row, verdict
from vla_eval.cli.main import main
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.records import EpisodeRecord

pytestmark = pytest.mark.usefixtures("in_this_process")


def right(n: int, of: int = 60) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.arange(of) < n


@pytest.mark.parametrize(
    ("best", "everything", "expected"),
    [
        (58, 60, ONE),
        (60, 20, ONE),  # more frames are more to fit, and may help less
        (20, 60, SEVERAL),
        (20, 22, UNREAD),
        (45, 53, UNREAD),  # above chance, but below 0.9: about the probe, not about the task
        (0, 0, UNREAD),
        (45, 60, SEVERAL),  # 15 pairs of 15: p = 0.0001
        (55, 60, ONE),  # 5 of 5: p = 0.06 does not tell
    ],
)
def test_the_verdict_is_that_of_the_pairs(best: int, everything: int, expected: str) -> None:
    assert verdict(right(best), right(everything), 1 / 3) == expected


def test_the_best_step_is_chosen_without_the_episodes_that_it_is_judged_on() -> None:
    folds = np.arange(10) % 5
    by_step = np.zeros((3, 10), dtype=bool)
    by_step[1] = True
    by_step[2, folds == 0] = True  # right in one fold alone: never the best of the others
    found, step = _best(by_step, folds)
    assert found.all() and step == 1
    lucky = np.zeros((2, 10), dtype=bool)
    lucky[0, 0], lucky[1, 1] = True, True
    assert _best(lucky, folds)[0].sum() <= 1


def audit(folder: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, Any]]:
    capsys.readouterr()
    command = ["audit", "--stored-frames", "--episodes", "40", "--workers", "1", "--out", str(folder)]
    assert main([*command, "--set", "simulator=fake", "--format", "json", *arguments]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def episode(seed: int, shown: tuple[int, ...]) -> tuple[EpisodeRecord, EpisodeMemory]:
    """An episode in which each item fills the image in turn, two steps long, and nothing is seen after."""
    rng = np.random.default_rng(seed)
    levels = [40 * (item + 1) for item in shown for _ in range(2)] + [0, 0]
    frames = np.array([np.full((4, 4, 3), level) for level in levels]) + rng.integers(0, 4, (8, 4, 4, 3))
    record = EpisodeRecord(
        task="ChainOfColors3-v0",
        policy="oracle",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success",
        right_candidates=shown,
        n_candidates=5,
    )
    memory = EpisodeMemory(
        steps=np.arange(8),
        memory={},
        frames={"base_camera": frames.astype(np.uint8)},
        in_cue=np.arange(8) < 6,
    )
    return record, memory


def test_items_shown_one_by_one_take_several_frames() -> None:
    rng = np.random.default_rng(0)
    # Two values for each of three places, so that one frame tells one of three.
    shown = [tuple(int(one) for one in (rng.integers(2), 2 + rng.integers(2), 4)) for _ in range(60)]
    row = _row("ChainOfColors3-v0", "order", [episode(seed, one) for seed, one in enumerate(shown)])
    assert row.all.n == 60
    assert row.verdict == SEVERAL
    # One frame tells one of the two that vary, and the other is guessed: about half.
    assert 15 <= row.best.n <= 45
    assert row.newest.n < 30
    one = [(n, 2, 4) for n in (0, 1) for _ in range(30)]
    row = _row("ChainOfColors3-v0", "set", [episode(seed, each) for seed, each in enumerate(one)])
    assert (row.first.n, row.all.n, row.verdict) == (60, 60, ONE)
    assert row.cue_end.n < 60  # the last frame of the cue shows the last item, which is always the same


def test_one_frame_is_enough_for_an_item(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (item,) = rows = audit(tmp_path, capsys, "--task", "RememberColor3-v0")
    assert (item["task"], item["asked"]) == ("RememberColor3-v0", "item")
    # 13 of 40 by chance; 24 and more with a probability below 0.0005. The rest of an image is noise there.
    assert min(item["first"]["n"], item["cue_end"]["n"]) >= 24 > item["newest"]["n"]
    assert audit(tmp_path, capsys, "--task", "RememberColor3-v0") == rows
    command = ["audit", "--stored-frames", "--episodes", "40", "--workers", "1", "--out", str(tmp_path)]
    assert main([*command, "--task", "RememberColor3-v0", "--set", "simulator=fake"]) == 0
    said = capsys.readouterr().out
    assert "| RememberColor3-v0 | item  |" in said and item["verdict"] in said


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--task", "InterceptMedium-v0"), "expected a task that shows candidates to be remembered"),
        (("--task", "RememberColor3-v0", "--control", "hold"), "--stored-frames has one control"),
        (("--task", "RememberColor3-v0", "--protocol", "paper"), "--stored-frames has one control"),
        (
            ("--task", "RememberColor3-v0", "--episodes", "5"),
            "expected frames of at least 20 episodes, found 5",
        ),
    ],
)
def test_a_mistake_is_one_message(
    arguments: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "audit",
        "--stored-frames",
        "--workers",
        "1",
        "--out",
        str(tmp_path),
        "--set",
        "simulator=fake",
    ]
    assert main([*command, *arguments]) == 1
    assert says in capsys.readouterr().err
