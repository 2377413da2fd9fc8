"""`report` and its page have a section on the probes among their run folders."""

import dataclasses
import re
from pathlib import Path

import pytest

from tests.probe.test_probe import TASK_CONFIG
from tests.probe.test_quantities import record
from vla_eval.cli.main import main
from vla_eval.config.evaluation import ProbedWorld
from vla_eval.errors import VlaEvalError
from vla_eval.evaluation.resolve import resolve
from vla_eval.page.build import build_page
from vla_eval.probe.choice_pairs import choice_pairs
from vla_eval.probe.find_worlds import find_probes
from vla_eval.probe.grid import GridSettings, plan_grid
from vla_eval.probe.interventions import plan_probe
from vla_eval.probe.page.sections import probe_sections
from vla_eval.probe.probe_text import probe_texts
from vla_eval.probe.world_records import by_policy
from vla_eval.probe.worlds import ProbeSettings
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import RunDescription, StoredRun
from vla_eval.viz.filmstrip import read_strip

pytestmark = pytest.mark.usefixtures("in_this_process")

TASK = "RememberColor3-v0"


def stored(
    name: str, *records: EpisodeRecord, folder: str = "runs/p", path: str | None = None, **env: object
) -> StoredRun:
    config = {"tasks": [TASK], "policies": ["p"], "env": {"delay_steps": 5, **env}}
    description = RunDescription(
        name=name, config=config, recipes={}, environment={}, options={}, command="mikasa-vla probe"
    )
    return StoredRun(path=Path(folder) / (path or name), description=description, records=records)


def world(rest: str, *choices: int | None, target: int = 0, **more: object) -> StoredRun:
    records = [record(seed, target=target, choice=choice) for seed, choice in enumerate(choices)]
    return stored(f"{TASK}_{rest}", *records, **more)  # type: ignore[arg-type]


PROBE_RUNS = [
    world("none", 0, 0, 0),
    world("swap_1", 1, 1, 0, target=1, swap_cue=1),
    world("delay_80", 0, 1, 2, delay_steps=80),
    world("grid_delay_5_from_0", 0, 1, 2),
]
"""Follows the cue in both worlds of two pairs of three; after 80 steps in one episode of three."""


def test_worlds_of_older_versions_are_found_by_their_names() -> None:
    runs = [
        world("swap_1", 1, target=1, swap_cue=1),
        world("delay_swap_80", 1, target=1, delay_steps=80),
        world("delay_80", 0, delay_steps=80),
        world("delay_9", 0, delay_steps=9),
        world("none", 0),
        world("instruction_other_task", 0),
        world("grid_delay_5_from_3", 0),
        stored("demo", record(1)),
        world("swap_1", 1, folder="runs/q"),  # without the world as drawn: an evaluation like any other
    ]
    (found,) = find_probes(runs)
    assert found.folder == Path("runs/p")
    assert [(one.world.intervention, one.world.level) for one in found.worlds] == [
        ("none", None),
        ("swap", 1),
        ("delay", 9),
        ("delay", 80),
        ("delay_swap", 80),
        ("instruction", "other_task"),
    ]
    (grid,) = found.grid
    assert (grid.world.axis, grid.world.level, grid.world.first_inference_step) == ("delay", 5, 3)
    assert grid.world.phases.response_step == 10
    assert find_probes([stored("demo", record(1)), world("none", 0)]) == []


def stating(name: str, world: object) -> StoredRun:
    run = stored(name, record(1))
    description = dataclasses.replace(run.description, options={"world": world})  # type: ignore[dict-item]
    return dataclasses.replace(run, description=description)


def test_worlds_are_found_by_what_their_files_state_whatever_they_are_called() -> None:
    runs = [
        stating("one", {"change": "none", "level": None, "first_inference_step": None}),
        stating("two", {"change": "mask", "level": "cue", "first_inference_step": None}),
        stating("three", {"change": "cue", "level": 7, "first_inference_step": 2}),
        stating(f"{TASK}_delay_80", {"change": "swap", "level": 2, "first_inference_step": None}),
        stating(f"{TASK}_swap_1", None),  # an evaluation that happens to be called so
    ]
    (found,) = find_probes(runs)
    assert [(one.world.intervention, one.world.level) for one in found.worlds] == [
        ("none", None),
        ("swap", 2),
        ("mask", "cue"),
    ]
    (grid,) = found.grid
    assert grid.world.place == (TASK, "cue", 7, 2, "receding_horizon")


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"change": "swaps"}, "Did you mean 'swap'"),
        ({"change": "swap", "by": 1}, r"options\.world\.by'"),
        ({"change": "delay", "level": "x", "first_inference_step": 1}, "a number, in a grid"),
        ("swap_1", "found 'swap_1'"),
    ],
)
def test_a_world_that_cannot_be_is_refused(world: object, message: str) -> None:
    with pytest.raises(VlaEvalError, match=message):
        find_probes([stating("one", world)])


def test_probes_and_grids_state_their_worlds_and_no_fingerprint_depends_on_it() -> None:
    worlds = [*plan_probe(TASK_CONFIG, ProbeSettings(probes=("swap",))).worlds]
    worlds += plan_grid(TASK_CONFIG, GridSettings(delays=(5,), first_inferences=(0,))).worlds
    stated = [one.config.world for one in worlds]
    assert stated == [
        ProbedWorld(change="none"),
        ProbedWorld(change="swap", level=1),
        ProbedWorld(change="delay", level=5, first_inference_step=0),
    ]
    for one in worlds:
        without = dataclasses.replace(one.config, world=None)
        assert resolve(one.config).fingerprint == resolve(without).fingerprint


def test_a_copy_of_a_world_is_not_counted_and_not_hidden() -> None:
    runs = [world("none", 0), world("swap_1", 1, target=1), world("swap_1", 0, target=1, path="old")]
    (text,) = probe_texts(runs)
    assert "old: it has the name of runs/p/RememberColor3-v0_swap_1, and is not in this section" in text
    (section,) = probe_sections(runs)
    assert any("old: it has the name" in note for note in section.notes)
    assert "follows the cue in both worlds in 1 of 1 pairs" in section.sentences[0]


def test_pairs_are_counted_by_the_choices_in_both_worlds() -> None:
    # Follows both cues twice; stays at 0 once; touches nothing in the swapped world once.
    drawn = [record(seed, target=0, choice=choice) for seed, choice in enumerate((0, 0, 0, 2))]
    other = [record(seed, target=1, choice=choice) for seed, choice in enumerate((1, 1, 0, None))]
    none, swap = plan_probe(TASK_CONFIG, ProbeSettings(probes=("swap",))).worlds
    (pairs,) = choice_pairs([(none, by_policy(drawn)), (swap, by_policy(other))], "p", 1)
    assert pairs.names == ("red", "green", "blue", "none")
    # By the indices of the names: as drawn, and in the other world.
    assert dict(pairs.counts) == {(0, 1): 2, (0, 0): 1, (2, 3): 1}
    assert dict(pairs.following) == {(0, 1): 2}


def test_report_prints_and_shows_what_probe_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "probe"
    base = ["probe", "--task", TASK, "--policy", "oracle", "--workers", "1", "--no-controls"]
    base += ["--episodes", "3", "--set", "simulator=fake", "--out", str(out)]  # 3 of 3: above chance
    assert main([*base, "--probe", "swap,delay", "--delay", "0", "--set", "capture.video=1"]) == 0
    printed = capsys.readouterr().out.strip()
    assert main([*base, "--grid", "--n-action-steps", "1", "--delay", "5"]) == 0
    grid = capsys.readouterr().out.strip()

    folders = [str(path) for path in sorted(out.iterdir())]
    assert main(["report", *folders]) == 0
    text = capsys.readouterr().out
    assert printed in text
    assert grid in text
    assert "First choices of oracle on RememberColor3-v0, K = 1: as drawn (rows), swap 1 (columns)" in text

    assert main(["report", *folders, "--html", str(tmp_path / "page")]) == 0
    page = (tmp_path / "page" / "index.html").read_text()
    section = re.search(r'<section id="probe">(.*?)</section>', page, re.S)
    assert section is not None
    for said in (
        "<h4>Retention</h4>",
        "more than 5 steps",
        "swap 1 (columns)",
        "success once by K and delay",
    ):
        assert said in section[1]
    assert section[1].count("<img") == 2 * 6  # two strips of six frames
    steps = [int(step) for step in re.findall(r">step (\d+)</span>", section[1])]
    assert steps[:6] == steps[6:] == sorted(set(steps))  # the same six in both, in order
    assert (steps[0], steps[5]) == (0, 60)
    assert '<a href="#probe">' in page

    (video,) = (out / f"{TASK}_swap_1" / "videos").glob("*.mp4")
    strip = read_strip(video, n_frames=3, n_steps=60, control_hz=20.0)
    assert (strip[0].step, strip[2].step) == (0, 60)
    assert strip[0].image.shape == (512, 768, 3)  # without the lines above the images


def test_without_a_probe_a_page_is_as_before() -> None:
    page = build_page([stored("demo", record(1))], probes=probe_sections([stored("demo", record(1))]))
    assert 'id="probe"' not in page
    assert "#probe" not in page
