"""Capturing changes nothing that a policy sees or does, and what it writes can be read."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from rerun.experimental import RrdReader

from tests.evaluation.resolved import evaluate, fingerprint
from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.config.environment import HUMAN_CAMERA, EnvSettings
from vla_eval.config.evaluation import CaptureConfig, EvalConfig, is_wanted, may_be_wanted
from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.errors import RecipeError, VlaEvalError
from vla_eval.page.filmstrip import write_filmstrips
from vla_eval.records import EpisodeRecord
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec
from vla_eval.storage.capture_files import rrd_file, stills_file, thumbnail_file, video_file
from vla_eval.storage.run_folder import read_run
from vla_eval.strict.decoding import decode
from vla_eval.tasks.interface import env_spec
from vla_eval.viz.contact_sheet import LABEL_PX, LEFT_PX
from vla_eval.viz.frames import FAILURE_COLOR, PANEL_PX, PHASE_COLORS, SUCCESS_COLOR, VIEW_PX, compose
from vla_eval.viz.moments import STILL_PX, find_moments, read_stills, write_stills
from vla_eval.viz.rerun_log import arm_points_m, events, n_overlapping, write_rrd
from vla_eval.viz.tape import Tapes
from vla_eval.viz.video import write_video

TASK = "RememberColor3-v0"
CAMERAS = ("base_camera", "hand_camera")
SHORT = {"horizon_steps": 8, "cue_steps": 2, "delay_steps": 2}


class Looker:
    """Moves at random and keeps a digest of every frame that it was given."""

    def __init__(self, reads: str = "last") -> None:
        self.spec = PolicySpec(
            name="looker",
            reads=reads,
            cameras=CAMERAS,
            states=("qpos",),
            chunk_size=3,  # type: ignore[arg-type]
        )
        self.frames: list[tuple[int, str, str]] = []

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self.rng = np.random.default_rng(episodes[0].seed)

    def act(self, window: ObservationWindow) -> ActionChunk:
        assert window.last.privileged is None
        for frame in window.frames:
            for name, image in frame.images.items():
                self.frames.append((frame.step, name, hashlib.sha256(image.tobytes()).hexdigest()))
        return ActionChunk(actions=self.rng.uniform(-1, 1, (3, 7)).astype(np.float32))


def play(
    *,
    captured: bool,
    reads: str = "last",
    simulator: str = "fake",
    stride: int = 2,
    n_action_steps: int = 3,
    tapes: Tapes | None = None,
) -> tuple[Looker, EpisodeRecord, Tapes]:
    policy = Looker(reads)
    observers = [tapes] if tapes else []
    if captured:
        observers = [Tapes({0}, frame_stride=stride)]
    tapes = observers[0] if observers else Tapes({0}, frame_stride=stride)
    settings = EnvSettings(task=TASK, kwargs=SHORT, simulator=simulator, cameras=CAMERAS)  # type: ignore[arg-type]
    if captured:
        settings = dataclasses.replace(settings, privileged=True, human_camera_stride=stride)
    env = make_env(settings)
    start = EpisodeStart(slot=0, task=TASK, seed=1, run=0, instruction="touch it", horizon_steps=8)
    try:
        (record,) = rollout(
            env,
            policy,
            [start],
            RolloutSettings(chunking=ChunkingSpec(n_action_steps=n_action_steps)),
            observers=observers,
        )
    finally:
        env.close()
    return policy, record, tapes


def film(tapes: Tapes, record: EpisodeRecord, path: Path, *, frame_rate_hz: float) -> None:
    write_video(
        tapes.episodes[0],
        record,
        path,
        thumbnail=path.with_suffix(".jpg"),
        stills=path.with_name("stills.jpg"),
        frame_rate_hz=frame_rate_hz,
    )


@pytest.mark.parametrize("reads", ["last", "every"])
def test_a_policy_sees_the_same_frames_bit_by_bit_whether_or_not_it_is_captured(reads: str) -> None:
    (plain, record, _), (filmed, filmed_record, _) = (
        play(captured=captured, reads=reads) for captured in (False, True)
    )
    assert plain.frames
    assert filmed.frames == plain.frames
    assert filmed_record == record


@pytest.mark.slow
def test_in_the_simulator_too(tmp_path: Path) -> None:
    (plain, record, _), (filmed, filmed_record, tapes) = (
        play(captured=captured, simulator="maniskill") for captured in (False, True)
    )
    assert filmed.frames == plain.frames
    assert filmed_record == record
    assert tapes.episodes[0].steps[0].result.observation.images[HUMAN_CAMERA].shape == (512, 512, 3)
    film(tapes, record, tmp_path / "a.mp4", frame_rate_hz=10)


def test_frames_are_captured_at_the_stride_and_at_the_end() -> None:
    _, _, tapes = play(captured=True, stride=3)
    steps = tapes.episodes[0].steps
    captured = [s.step for s in steps if HUMAN_CAMERA in s.result.observation.images]
    assert captured == [0, 3, 6, 8]  # every third of 8 steps, and the last
    assert [chunk.step for chunk in tapes.episodes[0].chunks] == [0, 3, 6]


def test_a_video_opens_and_is_as_long_as_what_was_captured(tmp_path: Path) -> None:
    _, record, tapes = play(captured=True, stride=4)
    path = tmp_path / "videos" / "a.mp4"
    film(tapes, record, path, frame_rate_hz=5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        n_frames = sum(1 for _ in container.decode(stream))
    with Image.open(path.with_suffix(".jpg")) as poster:
        assert poster.size == (2 * stream.width, stream.height)  # cue and choice
    # Steps 0, 4, 8, not 3 and 6, where the policy looked. Cue (step 0) and end are held for a second.
    assert n_frames == 5 + 1 + (1 + 5)
    assert not list(path.parent.glob("*.part"))


def test_facts_are_above_the_images_where_a_player_covers_nothing() -> None:
    _, record, tapes = play(captured=True, stride=4)
    tape = tapes.episodes[0]
    frame = compose(tape, tape.captured()[0], record)
    images = tape.captured()[0].result.observation.images
    assert frame.shape[:2] == (VIEW_PX + PANEL_PX, VIEW_PX + VIEW_PX // 2)
    # The viewer's image, below its label, reaches the lower edge; the strip is in the first rows.
    viewer = np.asarray(
        Image.fromarray(images[HUMAN_CAMERA]).resize((VIEW_PX, VIEW_PX), Image.Resampling.NEAREST)
    )
    assert np.array_equal(frame[PANEL_PX + 40 :, :VIEW_PX], viewer[40:])
    colors = {tuple(map(int, color)) for color in frame[8, :: VIEW_PX // 64]}
    assert colors & set(PHASE_COLORS.values())


def test_swatches_have_the_colours_of_target_and_choice_and_a_held_cue_is_said() -> None:
    _, record, tapes = play(captured=True, stride=4)
    tape = tapes.episodes[0]
    target = tape.steps[0].result.status.target
    assert target is not None
    red_green_blue = ((255, 0, 0), (0, 255, 0), (0, 0, 255))  # the colours of RememberColor3, in their order
    panel = compose(tape, tape.captured()[0], record)[:PANEL_PX]
    counts = [int((panel == color).all(axis=2).sum()) for color in red_green_blue]
    # The outline is of the ink's colour, so one pixel less on each side; nothing was chosen yet.
    assert [count > 0 for count in counts] == [index == target for index in range(3)]
    held = compose(tape, tape.captured()[0], record, n_held=5)[:PANEL_PX]
    assert not np.array_equal(held, panel)


def test_the_moments_of_an_episode_are_cue_reveal_and_touch(tmp_path: Path) -> None:
    _, _, tapes = play(captured=True, stride=1)
    tape = tapes.episodes[0]
    moments = find_moments(tape)
    choices = [one.step for one in tape.steps if one.result.status.first_choice is not None]
    # cue_steps 2, delay_steps 2: the response begins at step 4.
    assert [one.step for one in moments] == [0, 4, choices[0] if choices else 8]
    write_stills(tape, tmp_path / "stills.jpg")
    stills = read_stills(tmp_path / "stills.jpg")
    assert [still.shape for still in stills] == [(STILL_PX, STILL_PX, 3)] * 3
    smaller = tmp_path / "smaller.jpg"  # as they were written once
    Image.open(tmp_path / "stills.jpg").resize((3 * 128, 128)).save(smaller)
    assert [still.shape for still in read_stills(smaller)] == [(STILL_PX, STILL_PX, 3)] * 3


def test_a_video_that_cannot_be_written_says_where_and_of_what(tmp_path: Path) -> None:
    _, record, tapes = play(captured=True, stride=8)
    (tmp_path / "videos").write_text("a file in the way")
    path = tmp_path / "videos" / "a.mp4"
    with pytest.raises(VlaEvalError, match=r"videos/a\.mp4: the video of looker on \S+, seed 1, could"):
        film(tapes, record, path, frame_rate_hz=5)


def test_a_rerun_file_holds_what_was_seen_done_and_chosen(tmp_path: Path) -> None:
    _, record, tapes = play(captured=True, stride=4)
    path = tmp_path / "rrd" / "a.rrd"
    write_rrd(tapes.episodes[0], record, path, env=env_spec())

    reader = RrdReader(path)
    schema = reader.store().schema()
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    entities = set(schema.entity_paths())
    assert {f"/cameras/{name}" for name in (*CAMERAS, HUMAN_CAMERA)} <= entities
    assert {f"/actions/dx/{kind}" for kind in ("asked", "executed", "predicted_0")} <= entities
    assert {"/world/tcp", "/world/tcp_path", "/world/candidates", "/gripper/width", "/reward"} <= entities
    assert "/world/arm" not in entities  # the fake's joints are none
    assert {"/phase/cue", "/phase/delay", "/phase/response", "/events", "/instruction"} <= entities
    assert {"Index(timeline:step)", "Index(timeline:time)"} <= {str(one) for one in schema.index_columns()}


def test_the_arm_ends_where_the_simulator_has_the_tool_centre_point() -> None:
    env, draws = make_env(EnvSettings(task=TASK)), np.random.default_rng(0)
    result = env.reset({0: 1}, render=False)[0]
    for _ in range(10):
        state = result.observation.state
        points = arm_points_m(state["qpos"], state["tcp_pose"][:3])
        assert points is not None
        np.testing.assert_allclose(points[-1], state["tcp_pose"][:3], atol=1e-5)  # of a chain of a metre
        action = draws.uniform(-1, 1, 7).astype(np.float32)
        result = env.step({0: action}, render=frozenset())[0]


def test_another_arm_is_not_drawn_as_a_panda() -> None:
    assert arm_points_m(np.zeros(15), np.array([-0.12, 0.0, 0.30])) is None
    assert arm_points_m(np.zeros(6), np.zeros(3)) is None


def test_chunks_that_overlap_lie_in_series_of_their_own(tmp_path: Path) -> None:
    # Chunks of 3 actions every 2 steps: the third action of one is meant for the first step of the next.
    _, _, tapes = play(captured=True, stride=8, n_action_steps=2)
    assert n_overlapping(tapes.episodes[0]) == 2


def test_the_events_of_an_episode_are_its_phases_inferences_and_choice() -> None:
    _, record, tapes = play(captured=True, stride=8)
    said = list(events(tapes.episodes[0], record))
    # cue_steps 2, delay_steps 2: the delay begins at step 2, the response at step 4.
    assert [(s, text) for s, text in said if text.startswith("phase")] == [
        *((0, "phase cue"), (2, "phase delay"), (4, "phase response"))
    ]
    assert [s for s, text in said if text == "inference, 3 actions"] == [0, 3, 6]


def test_what_is_captured_is_decided_by_outcome_or_beforehand() -> None:
    assert is_wanted("failures", run=3, index=9, is_success=False)
    assert not is_wanted("failures", run=0, index=0, is_success=True)
    assert is_wanted("successes", run=0, index=0, is_success=True)
    # The first two seeds of run 0, whatever their outcome; the others are not captured.
    kept = [(run, index) for run in (0, 1) for index in range(4) if may_be_wanted(2, run=run, index=index)]
    assert kept == [(0, 0), (0, 1)]
    assert not may_be_wanted("none", run=0, index=0)


def test_a_number_of_episodes_below_one_is_refused() -> None:
    with pytest.raises(RecipeError, match=r"capture\.video is 0"):
        CaptureConfig(video=0)


def test_capturing_gives_a_run_no_other_fingerprint() -> None:
    data = {"name": "films", "tasks": [TASK], "policies": ["oracle"]}
    plain, filmed = (
        decode(EvalConfig, data | more, where="test") for more in ({}, {"capture": {"video": "all"}})
    )
    assert fingerprint(plain) == fingerprint(filmed)


def test_a_mistyped_choice_is_answered(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "demo", "--capture-video", "failure"]) == 1
    assert "Did you mean 'failures'?" in capsys.readouterr().err


def test_a_run_captures_what_it_was_asked_to_and_nothing_else(tmp_path: Path) -> None:
    data = {"name": "films", "tasks": [TASK], "policies": ["cue_blind"], "episodes": 3}
    data |= {"env": SHORT | {"horizon_steps": 30}, "simulator": "fake", "workers": 1}
    capture = {"video": "failures", "rrd": 1, "frame_stride": 30}
    config = decode(EvalConfig, data | {"capture": capture}, where="test")
    assert evaluate(config, out=tmp_path / "filmed").n_errors == 0
    folder = tmp_path / "filmed"
    run = read_run(folder)
    failures = {record.key for record in run.records if record.outcome == "failure"}
    assert 0 < len(failures) < 3  # else the test below would show nothing
    for record in run.records:
        assert video_file(folder, record).exists() == (record.key in failures)
        assert thumbnail_file(folder, record).exists() == (record.key in failures)
        assert rrd_file(folder, record).exists() == (record.seed == 1)
        assert stills_file(folder, record).exists() == (record.key in failures)
    assert "capture" not in run.description.config
    assert run.description.options["capture"] == capture | {"strip": "none", "memory": False, "frames": False}


@pytest.mark.parametrize(("which", "outcome"), [("failures", "failure"), ("successes", "success")])
def test_what_the_outcome_selects_is_filmed_afterwards_as_if_all_had_been_filmed(
    which: str, outcome: str, tmp_path: Path
) -> None:
    data = {"name": "films", "tasks": [TASK], "policies": ["cue_blind"], "episodes": 3, "workers": 1}
    data |= {"env": SHORT | {"horizon_steps": 30}, "simulator": "fake", "slots_per_worker": 2}
    runs = {}
    for wanted in ("none", which, "all"):
        config = decode(EvalConfig, data | {"capture": {"video": wanted, "frame_stride": 10}}, where="test")
        assert evaluate(config, out=tmp_path / wanted).n_errors == 0
        runs[wanted] = sorted(read_run(tmp_path / wanted).records, key=lambda record: record.key)
    assert runs["none"] == runs[which] == runs["all"]
    filmed = [record for record in runs[which] if record.outcome == outcome]
    assert 0 < len(filmed) < 3
    for record in runs["all"]:
        there, whole = (video_file(tmp_path / wanted, record) for wanted in (which, "all"))
        assert there.exists() == (record in filmed)
        assert not there.exists() or there.read_bytes() == whole.read_bytes()


def test_a_filmstrip_shows_the_captured_seeds_of_a_row_with_an_edge_for_the_outcome(tmp_path: Path) -> None:
    data = {"name": "films", "tasks": [TASK], "policies": ["cue_blind", "hold"], "episodes": 3, "workers": 1}
    data |= {
        "env": SHORT | {"horizon_steps": 30},
        "simulator": "fake",
        "capture": {"video": 2, "frame_stride": 30},
    }
    evaluate(decode(EvalConfig, data, where="test"), out=tmp_path / "run")
    run = read_run(tmp_path / "run")
    for path in (tmp_path / "run/videos").glob("*hold*"):
        path.unlink()

    made = write_filmstrips([run], tmp_path / "strips")

    assert [path.name for path in made.files] == [f"{TASK}_cue_blind_K1.png"]
    assert made.not_captured == (f"{TASK} hold K1",)
    sheet = np.asarray(Image.open(made.files[0]))
    # Two lines of title and one of columns, an edge and a margin below them; two seeds, three frames each.
    top, pitch = 3 * LABEL_PX + 3 + 8, STILL_PX + 8
    assert sheet.shape[:2] == (top + 2 * pitch + 8, LEFT_PX + 3 * pitch + 8)
    edges = [tuple(map(int, sheet[top + i * pitch + 9, LEFT_PX - 1])) for i in range(2)]
    outcome = {record.seed: record.outcome for record in run.records if record.policy == "cue_blind"}
    assert edges == [SUCCESS_COLOR if outcome[seed] == "success" else FAILURE_COLOR for seed in (1, 2)]


def test_a_run_without_captures_says_how_to_make_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = {"name": "films", "tasks": [TASK], "policies": ["hold"], "episodes": 1, "simulator": "fake"}
    evaluate(decode(EvalConfig, data | {"env": SHORT}, where="test"), out=tmp_path / "run")
    assert main(["report", str(tmp_path / "run"), "--filmstrip", str(tmp_path / "strips")]) == 1
    assert "--capture-video 10 --out DIR" in capsys.readouterr().err
