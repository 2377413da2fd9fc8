"""The drawing of an episode: it shows the chunks as they were executed, and needs no image."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import pytest

from tests.test_rollout import Pusher, env_for, start
from vla_eval.chunking import EXECUTIONS, ChunkingSpec
from vla_eval.config.evaluation import CaptureConfig
from vla_eval.latency import VaryingDelay
from vla_eval.motion import HELD
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.viz.strip import sources_of, write_strip
from vla_eval.viz.tape import Tapes

DRAWN = VaryingDelay(steps=(1, 3, 6))


def episode(**fields: Any) -> Any:
    """An episode's tape and record, and how its chunks were executed."""
    chunking = ChunkingSpec(n_action_steps=4, **fields)
    policy, tapes = Pusher(chunk_size=8), Tapes([0], frame_stride=2, with_images=False)
    policy.spec = dataclasses.replace(policy.spec, reads_committed=True)
    settings = RolloutSettings(chunking=chunking)
    (record,) = rollout(env_for(policy), policy, [start()], settings, observers=[tapes])
    return tapes.episodes[0], record, chunking


@pytest.mark.parametrize("mode", EXECUTIONS)
@pytest.mark.parametrize("delay", [0, 3, DRAWN])
def test_each_step_is_of_the_chunk_that_was_executed(mode: Any, delay: Any) -> None:
    tape, record, chunking = episode(mode=mode, delay=delay)

    sources = sources_of(tape, record, chunking)

    assert len(sources) == record.n_steps
    assert sources.count(HELD) == record.n_held_steps
    ages = [step - source for step, source in enumerate(sources) if source != HELD]
    assert sum(ages) / len(ages) == record.mean_age_steps


def test_the_same_episode_gives_the_same_file(tmp_path: Path) -> None:
    env = env_for(Pusher()).spec
    files = [tmp_path / "a" / "one.svg", tmp_path / "b" / "two.svg"]
    for file in files:
        file.parent.mkdir()
        tape, record, chunking = episode(delay=DRAWN)
        write_strip(tape, record, file, env=env, chunking=chunking)

    first, second = (file.read_text() for file in files)
    assert first == second
    assert "receding_horizon, delays of its own" in first


@pytest.mark.parametrize(
    ("video", "rrd", "strip"),
    [*itertools.product(["none", "all", "failures"], ["none", 2], ["none", "all"])],
)
def test_a_drawing_alone_renders_nothing(video: Any, rrd: Any, strip: Any) -> None:
    config = CaptureConfig(video=video, rrd=rrd, strip=strip)

    assert config.is_on == ((video, rrd, strip) != ("none", "none", "none"))
    assert config.needs_images == ((video, rrd) != ("none", "none"))
    if not config.needs_images:
        assert config.films_afterwards("cpu") and config.films_afterwards("gpu")
