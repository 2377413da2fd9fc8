"""What an unattended run writes into its log: how far it has come, and how long the rest takes."""

import pytest

from vla_eval.cli.terminal.episode_bar import EpisodeBar
from vla_eval.cli.terminal.progress import load_text, success_text
from vla_eval.workers.load import Load, MachineLoad


class Clock:
    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def test_a_line_tells_what_is_left_at_the_rate_of_this_start(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    bar = EpisodeBar(clock=clock)
    bar.begin(n_done=10, n_total=50, title="RememberColor3-v0")
    bar.advance(n_done=14, note="success 0.50, errors 0")
    clock.seconds += 29
    bar.tick()
    assert capsys.readouterr().err == ""
    clock.seconds += 1
    bar.tick()
    # 4 episodes in half a minute, 36 are left.
    assert "8.0 per minute, 4.5 min left" in capsys.readouterr().err
    clock.seconds += 59
    bar.tick()
    assert capsys.readouterr().err == ""
    clock.seconds += 31
    bar.tick()
    # 4 episodes in 2 minutes; the 10 of before took none of them. 36 are left.
    assert capsys.readouterr().err == (
        "RememberColor3-v0: 14/50 episodes after 2.0 min, 2.0 per minute, 18.0 min left, "
        "success 0.50, errors 0\n"
    )


def test_no_remaining_time_is_made_up_before_an_episode_has_ended(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    bar = EpisodeBar(clock=clock)
    bar.begin(n_done=0, n_total=5)
    clock.seconds += 30
    bar.tick()
    assert capsys.readouterr().err == (
        "0/5 episodes after 0.5 min, none has ended yet, so the remaining time is unknown\n"
    )


def test_a_line_says_what_is_done_before_the_first_episode_ends_then_steps(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = Clock()
    bar = EpisodeBar(clock=clock)
    bar.begin(n_done=0, n_total=5)
    bar.doing("loading simulator and policies")
    clock.seconds += 30
    bar.tick()
    assert capsys.readouterr().err.startswith(
        "0/5 episodes after 0.5 min, loading simulator and policies, none"
    )
    bar.advance(n_done=1, n_steps=60)
    bar.advance(n_done=2, n_steps=1200)
    clock.seconds += 60
    bar.tick()
    assert "2/5 episodes (1,260 control steps) after 1.5 min" in capsys.readouterr().err


def test_steps_of_episodes_under_way_count_and_the_queue_is_at_the_end_of_the_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = Clock()
    bar = EpisodeBar(clock=clock)
    bar.begin(n_done=0, n_total=8)
    bar.advance(n_done=1, n_steps=60, note="success 1.00, errors 0")
    one = MachineLoad(
        name="a", is_used=True, n_workers=2, n_running=2, n_done=1, per_second=0.1, n_gpus=1, gpu_share=0.5
    )
    load = Load(n_running=2, n_counted=25, machines=(one,))
    bar.load(load_text(load, n_open=7), n_steps=load.n_counted)
    clock.seconds += 30
    bar.tick()
    # 60 steps of the first episode and 25 of those under way; 2 of the 7 others are running.
    told = capsys.readouterr().err
    assert "1/8 episodes (85 control steps)" in told
    assert told.endswith("success 1.00, errors 0, 1 machine, GPUs 50% busy, 5 episodes in the queue\n")
    assert load_text(Load(n_running=2), n_open=7) == ""  # this machine alone


def test_the_end_is_told_once_and_nothing_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    bar = EpisodeBar(clock=clock)
    bar.begin(n_done=0, n_total=2)
    bar.advance(n_done=2)
    clock.seconds += 60
    bar.close()
    bar.close()
    assert capsys.readouterr().err == "2/2 episodes after 1.0 min, 2.0 per minute\n"


def test_where_nothing_was_done_nothing_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    bar = EpisodeBar(clock=Clock())
    bar.begin(n_done=2, n_total=2)
    bar.close()
    assert capsys.readouterr().err == ""


def test_steps_of_an_episode_are_counted_once_when_it_ends(capsys: pytest.CaptureFixture[str]) -> None:
    bar = EpisodeBar(clock=Clock())
    bar.begin(n_done=0, n_total=2)
    bar.load("", n_steps=60 + 42)  # two episodes under way
    bar.load("", n_steps=42)  # the workers are asked again before a record is handed out
    bar.advance(n_done=1, n_steps=60)
    bar.close()
    assert "1/2 episodes (102 control steps)" in capsys.readouterr().err


def test_success_is_of_each_policy_and_left_out_where_there_are_many() -> None:
    assert success_text({}) == "no result yet, "
    assert success_text({"mine": [True, False], "oracle": [True]}) == "success mine 0.50, oracle 1.00; "
    assert success_text({f"policy{index}": [True] for index in range(5)}) == ""
