"""A policy that is reset in mid-episode, on the fake simulator."""

from collections.abc import Sequence

from tests.test_rollout import HORIZON, Pusher, run
from vla_eval.core import EpisodeStart


class TestResetInMidEpisode:
    def test_the_policy_is_reset_once_and_is_given_no_earlier_frame(self) -> None:
        policy = Pusher(reads="every", chunk_size=4)
        resets: list[int] = []
        begin = policy.reset

        def reset(episodes: Sequence[EpisodeStart]) -> None:
            resets.append(len(policy.windows))
            begin(episodes)

        policy.reset = reset  # type: ignore[method-assign]

        record = run(policy, n_action_steps=4, reset_policy_at_step=10)

        # Inferences at 0, 4, 8, 12 …: the fourth is the first one at or after step 10.
        assert resets == [0, 3]
        steps = [[frame.step for frame in window.frames] for window in policy.windows]
        assert steps[:5] == [[0], [1, 2, 3, 4], [5, 6, 7, 8], [10, 11, 12], [13, 14, 15, 16]]
        assert record.n_frames == HORIZON - 3 - 1  # frames 0 to 56, without 9

    def test_without_it_an_episode_is_as_before(self) -> None:
        one, other = run(Pusher()), run(Pusher(), reset_policy_at_step=None)
        assert one == other
        # After a reset the draws begin again, so the episode is another one.
        assert run(Pusher(), reset_policy_at_step=30).trajectory_sha256 != one.trajectory_sha256
