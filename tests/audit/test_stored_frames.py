"""How much has to be stored: verdicts from made-up answers, and the audit on the fake simulator."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.audit.frame_probes import FrameProbes, best_option
from vla_eval.audit.readings import READINGS, background, colours, pixels, places
from vla_eval.audit.stored_frames import _row, fewest_frames, verdict
from vla_eval.cli.main import main
from vla_eval.evaluation.memory_log import EpisodeMemory
from vla_eval.records import EpisodeRecord
from vla_eval.results.shipped_audit import NEWEST, ONE, SEVERAL, UNREAD
from vla_eval.tasks.catalog import OFFICIAL_TASKS
from vla_eval.tasks.spec import TaskSpec

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
    found, step = best_option(by_step, folds)
    assert found.all() and step == 1
    lucky = np.zeros((2, 10), dtype=bool)
    lucky[0, 0], lucky[1, 1] = True, True
    assert best_option(lucky, folds)[0].sum() <= 1


def remembered(*right: int) -> EpisodeRecord:
    """A record of an episode in which these are right, in this order."""
    return EpisodeRecord(
        task="ChainOfColors3-v0",
        policy="oracle",
        n_action_steps=1,
        run=0,
        seed=1,
        outcome="success",
        right_candidates=right,
        n_candidates=5,
    )


def shown(*steps: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.array([[candidate in step for candidate in range(5)] for step in steps])


@pytest.mark.parametrize(
    ("steps", "right", "expected"),
    [
        ([(1,), (1,), ()], (1,), 1),
        ([(), (0, 2, 4), ()], (4, 0, 2), 1),  # all at once
        ([(0,), (2,), (4,), ()], (4, 0, 2), 3),  # in turn
        ([(0, 2), (2, 4), ()], (4, 0, 2), 2),  # the fewest that cover it
        ([(0,), (2,), (0, 2)], (0, 2), 1),
        ([(0,), (2,)], (0, 2, 4), None),  # one is never shown
        ([(), ()], (1,), None),
        ([(1,)], (), None),  # nothing is asked
    ],
)
def test_the_fewest_frames_that_show_all_that_is_right(
    steps: list[tuple[int, ...]], right: tuple[int, ...], expected: int | None
) -> None:
    assert fewest_frames(shown(*steps), remembered(*right)) == expected


@pytest.mark.parametrize(
    ("steps", "right", "expected"),
    [
        ([(0, 2, 3, 4), ()], (1,), 1),  # all others at once
        ([(0, 2), (3, 4), ()], (1,), 2),  # in turn
        ([(0, 2, 3), ()], (1,), None),  # one of the others is never shown: it may be that one
        ([(0, 1, 2, 3, 4)], (1,), 1),
    ],
)
def test_what_a_cue_leaves_out_is_told_by_all_others(
    steps: list[tuple[int, ...]], right: tuple[int, ...], expected: int | None
) -> None:
    assert fewest_frames(shown(*steps), remembered(*right), left_out=True) == expected


def test_each_episode_has_its_own_first_frame_and_end_of_the_cue() -> None:
    lengths = {seed: (2 + seed % 3, 1 + seed % 2) for seed in range(6)}  # steps of the cue, and of the delay

    def memory(seed: int) -> EpisodeMemory:
        cue, delay = lengths[seed]
        levels = [10 + step for step in range(cue)] + [100 + step for step in range(delay)] + [200]
        frames = np.array([np.full((8, 8, 3), level, np.uint8) for level in levels])
        steps = np.arange(len(levels))
        return EpisodeMemory(steps=steps, memory={}, frames={"base_camera": frames}, in_cue=steps < cue)

    memories = [memory(seed) for seed in lengths]
    found = FrameProbes.of(memories, [(seed % 2,) for seed in lengths], list(lengths))
    pixel = found.features[0][0][:, :, 0]  # of the reading `pixels`
    assert (pixel[:, found.newest] == 200).all()
    assert (pixel[:, found.first] == 10).all()
    assert pixel[:, found.cue_end].tolist() == [10 + cue - 1 for cue, _ in lengths.values()]
    # Between them the frames are those before the newest, as many as the shortest episode has.
    assert not found.is_aligned and found.own == (found.first, found.cue_end)
    assert found.newest == min(map(sum, lengths.values()))
    assert pixel[:, found.newest - 1].tolist() == [100 + delay - 1 for _, delay in lengths.values()]


@pytest.mark.parametrize("spec", [one for one in OFFICIAL_TASKS.values() if one.has_candidates])
def test_what_the_cue_of_an_official_task_says(spec: TaskSpec) -> None:
    assert spec.cue_leaves_out == ("Imposter" in spec.id)
    assert spec.is_tracked == ("Shuffle" in spec.id)
    assert spec.has_alike_candidates == ("ShellGame" in spec.id)


def test_without_the_true_state_it_is_not_known() -> None:
    assert fewest_frames(None, remembered(1)) is None


@pytest.mark.parametrize("seed", range(5))
def test_colours_do_not_depend_on_the_place_and_places_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = np.full((6, 2, 32, 32, 3), 90, np.uint8)  # a grey table: the background
    colour = rng.integers(0, 256, 3)
    for episode, (row, column) in enumerate(rng.integers(0, 7, (5, 2)) * 4):
        frames[episode, 0, row : row + 4, column : column + 4] = colour
    found = {name: read(frames, background(frames)) for name, read in READINGS.items()}
    assert found["colours"].shape == (6, 2, 125) and found["places"].shape == (6, 2, 9 * 64)
    if np.abs(colour.astype(int) - 90).sum() > 40:
        # 16 pixels of one colour, in one block: the root is 4 wherever they are.
        assert (found["colours"][:5, 0].max(axis=1) == 4).all()
        assert (found["places"][:5, 0].max(axis=1) == 4).all()
        assert (found["colours"][:5, 0] == found["colours"][0, 0]).all()
    assert not found["colours"][:, 1].any() and not found["places"][5].any()  # nothing there but the table
    assert (pixels(frames, background(frames))[..., :3] == frames[:, :, 0, 0]).all()


def test_each_hue_and_each_grey_has_a_bin_of_its_own() -> None:
    named = [(255, 0, 0), (255, 255, 0), (0, 255, 0), (0, 255, 255), (0, 0, 255), (255, 0, 255)]
    named += [(10, 10, 10), (120, 120, 120), (250, 250, 250)]
    frames = np.full((19, 1, 8, 8, 3), 200, np.uint8)
    for episode, rgb in enumerate(named):
        frames[episode, 0, 0, 0] = rgb
    assert sorted(places(frames, background(frames))[:9, 0].argmax(axis=1) // 64) == list(range(9))
    assert len(set(colours(frames, background(frames))[:9, 0].argmax(axis=1))) == 9


def audit(folder: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, Any]]:
    capsys.readouterr()
    command = ["audit", "--stored-frames", "--episodes", "40", "--workers", "1", "--out", str(folder)]
    assert main([*command, "--set", "simulator=fake", "--format", "json", *arguments]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def episode(seed: int, items: tuple[int, ...]) -> tuple[EpisodeRecord, EpisodeMemory]:
    """An episode in which each item fills the image in turn, two steps long, and nothing is seen after."""
    rng = np.random.default_rng(seed)
    levels = [40 * (item + 1) for item in items for _ in range(2)] + [0, 0]
    frames = np.array([np.full((4, 4, 3), level) for level in levels]) + rng.integers(0, 4, (8, 4, 4, 3))
    record = replace(remembered(*items), seed=seed)
    memory = EpisodeMemory(
        steps=np.arange(8),
        memory={},
        frames={"base_camera": frames.astype(np.uint8)},
        in_cue=np.arange(8) < 6,
        shown=shown(*(() if step > 5 else (items[step // 2],) for step in range(8))),
    )
    return record, memory


def test_items_shown_one_by_one_take_several_frames() -> None:
    rng = np.random.default_rng(0)
    # Two values for each of three places, so that one frame tells one of three.
    drawn = [tuple(int(one) for one in (rng.integers(2), 2 + rng.integers(2), 4)) for _ in range(60)]
    row = _row("ChainOfColors3-v0", "order", [episode(seed, one) for seed, one in enumerate(drawn)])
    assert row.all == 60
    assert (row.probes, row.n_frames, row.verdict) == (SEVERAL, 3, SEVERAL)
    # One frame tells one of the two that vary, and the other is guessed: about half.
    assert 15 <= row.best <= 45
    assert row.newest < 30
    one = [(n, 2, 4) for n in (0, 1) for _ in range(30)]
    row = _row("ChainOfColors3-v0", "set", [episode(seed, each) for seed, each in enumerate(one)])
    # Two of the three are the same in all episodes: probes need not see them, an arm must.
    assert (row.first, row.all, row.probes) == (60, 60, ONE)
    assert (row.n_frames, row.verdict) == (3, SEVERAL)
    assert row.cue_end < 60  # the last frame of the cue shows the last item, which is always the same


def test_where_the_newest_frame_tells_the_answer_nothing_has_to_be_stored() -> None:
    def lit(seed: int, item: int) -> tuple[EpisodeRecord, EpisodeMemory]:
        record, memory = episode(seed, (item, 2, 4))
        frames = memory.frames["base_camera"].copy()
        frames[-1] = 60 * (item + 1)  # as a lamp of the colour that was always shown at the same place
        return record, replace(memory, frames={"base_camera": frames})

    row = _row("ChainOfColors3-v0", "set", [lit(seed, seed % 2) for seed in range(40)])
    assert (row.newest, row.probes, row.verdict) == (40, NEWEST, NEWEST)
    assert row.n_frames == 3  # all the same


def test_one_frame_is_enough_for_an_item(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (item,) = rows = audit(tmp_path, capsys, "--task", "RememberColor3-v0")
    assert (item["task"], item["asked"]) == ("RememberColor3-v0", "item")
    # 13 of 40 by chance; 24 and more with a probability below 0.0005. The rest of an image is noise there.
    assert min(item["first"], item["cue_end"]) >= 24 > item["newest"]
    assert (item["n_frames"], item["verdict"]) == (1, ONE)
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
