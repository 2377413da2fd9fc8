"""Several episodes that remember, in one forward pass: each in its row, whoever else is there."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.checkpoints.small_checkpoints import FAKE, TASK, context_for
from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import Bench
from vla_eval.core import EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, InvalidActionError
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot

bench = evaluation_bench.bench

N_ROWS = 3
ROWS = {1: 0, 2: 1, 3: 2}  # of the episodes with these seeds
CHECKPOINT = "memory_color3"
ROUNDING = 1e-4  # float32, sums of some thousand terms in another order; actions in [-1, 1]


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """As a worker of an evaluation has."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make(n_rows: int, **args: Any) -> LeRobotPolicy:
    context = replace(context_for(make_env(FAKE).spec), n_slots=n_rows)
    return make_lerobot(context, checkpoint=CHECKPOINT, device="cpu", **args)


def frame(seed: int, step: int) -> Observation:
    draws = np.random.default_rng((seed, step))
    images = draws.integers(0, 256, (2, 128, 128, 3), dtype=np.uint8)
    moved = draws.normal(0, 0.05, 3).astype(np.float32)
    pose = np.array([0, 0, 0.2, 0, 1, 0, 0], dtype=np.float32)
    pose[:3] += moved
    return Observation(
        step=step,
        images={"base_camera": images[0], "hand_camera": images[1]},
        state={"tcp_pose": pose, "qpos": np.zeros(9, np.float32), "qvel": np.zeros(9, np.float32)},
    )


class Table:
    """Episodes by their seed, in slots and rows of a policy, and how many frames each has been shown."""

    def __init__(self, policy: LeRobotPolicy, slots: Mapping[int, int], rows: Mapping[int, int]) -> None:
        self.policy, self.slots, self.rows = policy, slots, rows
        self.n_shown: dict[int, int] = {}

    def begin(self, *seeds: int) -> None:
        self.n_shown.update(dict.fromkeys(seeds, 0))
        self.policy.reset(
            [
                EpisodeStart(
                    slot=self.slots[seed],
                    row=self.rows[seed],
                    task=TASK,
                    seed=seed,
                    run=0,
                    instruction="touch it",
                    horizon_steps=60,
                )
                for seed in seeds
            ]
        )

    def ask(self, n_frames: Mapping[int, int]) -> dict[int, bytes]:
        """Show each of these episodes so many new frames, in this order; return their chunks."""
        windows = []
        for seed, n_new in n_frames.items():
            first = self.n_shown[seed]
            self.n_shown[seed] += n_new
            frames = tuple(frame(seed, step) for step in range(first, first + n_new))
            windows.append(ObservationWindow(slot=self.slots[seed], frames=frames))
        chunks = self.policy.act_batch(windows)
        return {seed: chunk.actions.tobytes() for seed, chunk in zip(n_frames, chunks, strict=True)}


def answers_of(seed: int, answers: Sequence[Mapping[int, bytes]]) -> list[bytes]:
    return [answer[seed] for answer in answers if seed in answer]


@pytest.fixture(scope="module")
def policy() -> LeRobotPolicy:
    return make(N_ROWS)


@pytest.fixture(scope="module")
def together(policy: LeRobotPolicy) -> list[dict[int, bytes]]:
    """Three episodes; the second begins later, the third pauses, and each has its own new frames."""
    table = Table(policy, {1: 7, 2: 0, 3: 41}, ROWS)
    table.begin(1, 3)
    answers = [table.ask({1: 1, 3: 1})]
    table.begin(2)
    answers.append(table.ask({3: 2, 2: 1, 1: 4}))
    answers.append(table.ask({2: 3, 1: 1}))
    answers.append(table.ask({1: 2, 2: 1, 3: 5}))
    return answers


class TestRows:
    @pytest.mark.parametrize(("seed", "n_frames"), [(1, [1, 4, 1, 2]), (2, [1, 3, 1]), (3, [1, 2, 5])])
    def test_alone_an_episode_gets_the_bits_that_it_gets_beside_others(
        self, policy: LeRobotPolicy, together: list[dict[int, bytes]], seed: int, n_frames: list[int]
    ) -> None:
        alone = Table(policy, {seed: 3}, ROWS)  # in another slot, in the same row
        alone.begin(seed)

        assert [alone.ask({seed: n})[seed] for n in n_frames] == answers_of(seed, together)

    def test_order_neighbours_and_slots_change_no_bit(
        self, policy: LeRobotPolicy, together: list[dict[int, bytes]]
    ) -> None:
        other = Table(policy, {1: 1, 2: 2, 3: 0, 9: 5}, {**ROWS, 9: 2})
        other.begin(9, 2, 1)
        answers = [other.ask({9: 3, 1: 1, 2: 1}), other.ask({1: 4}), other.ask({1: 1, 2: 3, 9: 1})]
        answers += [other.ask({2: 1, 1: 2})]

        assert answers_of(1, answers) == answers_of(1, together)
        assert answers_of(2, answers) == answers_of(2, together)

    def test_a_pass_of_several_agrees_with_passes_of_one_up_to_rounding(
        self, together: list[dict[int, bytes]]
    ) -> None:
        alone = Table(make(1), {1: 0}, {1: 0})
        alone.begin(1)

        for n, expected in zip([1, 4, 1, 2], answers_of(1, together), strict=True):
            chunk = np.frombuffer(alone.ask({1: n})[1], np.float32)
            np.testing.assert_allclose(np.frombuffer(expected, np.float32), chunk, atol=ROUNDING)

    def test_with_one_slot_it_is_asked_as_the_network_is(self) -> None:
        """One call of `remember` with all new frames (1, T, …), then one for the chunk."""
        policy = make(1)
        table, network = Table(policy, {1: 0}, {1: 0}), make(1)._loaded.policy
        inputs, preprocess = policy._inputs, policy._loaded.preprocessor
        table.begin(1)
        memory, first = None, 0
        for n in (1, 4, 2):
            stop = first + n
            tensors = [inputs.tensors(frame(1, step)) for step in range(first, stop)]
            seen = {key: torch.stack([each[key] for each in tensors])[None] for key in tensors[0]}
            newest = {key: value[None] for key, value in tensors[-1].items()}
            with torch.no_grad():
                memory = network.remember(preprocess({**seen, "task": ["touch it"]}), memory)
                chunk = network.predict_action_chunk(preprocess({**newest, "task": ["touch it"]}), memory)
            expected = policy._loaded.postprocessor(chunk)[0].numpy()

            assert table.ask({1: n})[1] == expected.astype(np.float32).tobytes()
            first = stop

    def test_a_new_episode_in_a_slot_remembers_nothing_of_the_last_one(
        self, policy: LeRobotPolicy, together: list[dict[int, bytes]]
    ) -> None:
        table = Table(policy, {9: 7, 1: 7}, {9: 0, 1: 0})
        table.begin(9)
        table.ask({9: 3})
        table.begin(1)

        assert table.ask({1: 1})[1] == together[0][1]

    def test_two_episodes_in_one_row_of_a_pass_are_refused(self, policy: LeRobotPolicy) -> None:
        table = Table(policy, {1: 4, 2: 6}, {1: 1, 2: 1})
        table.begin(1, 2)

        with pytest.raises(InvalidActionError, match="slots 4 and 6: both are in row 1"):
            table.ask({1: 1, 2: 1})

    def test_a_row_beyond_the_pass_is_refused(self, policy: LeRobotPolicy) -> None:
        table = Table(policy, {1: 4}, {1: 3})
        table.begin(1)

        with pytest.raises(InvalidActionError, match="slot 4: expected a row from 0 to 2, found 3"):
            table.ask({1: 1})

    @pytest.mark.parametrize("n_rows", [1, N_ROWS])
    def test_a_call_that_fails_can_be_made_again(
        self, monkeypatch: pytest.MonkeyPatch, n_rows: int, together: list[dict[int, bytes]]
    ) -> None:
        policy = make(n_rows)
        network = policy._loaded.policy
        rows = {seed: row % n_rows for seed, row in ROWS.items()}
        tables = [Table(policy, {1: 0}, rows), Table(policy, {1: 1}, rows)]
        answers = []
        for is_disturbed, table in enumerate(tables):
            table.begin(1)
            answers.append([table.ask({1: 1})])
            if is_disturbed:
                with monkeypatch.context() as patched:
                    patched.setattr(network, "predict_action_chunk", lambda *a, **k: 1 / 0)
                    with pytest.raises(CheckpointError, match="ZeroDivisionError"):
                        table.ask({1: 4})
                table.n_shown[1] -= 4
            answers[-1].append(table.ask({1: 4}))

        assert answers[0] == answers[1]

    def test_batch_false_asks_for_one_after_the_other(self) -> None:
        alone, one_by_one = Table(make(1), {1: 0}, ROWS), Table(make(N_ROWS, batch=False), {1: 0, 2: 1}, ROWS)
        alone.begin(1)
        one_by_one.begin(1, 2)

        for n in (1, 3):
            assert one_by_one.ask({1: n, 2: 1})[1] == alone.ask({1: n})[1]


class TestEvaluation:
    @pytest.mark.slow
    def test_any_number_of_workers_gives_the_same_lines(self, bench: Bench) -> None:
        fields: dict[str, Any] = {
            "policies": [CHECKPOINT],
            "n_action_steps": [3],
            "episodes": 6,
            "slots_per_worker": 4,
        }
        for workers in (1, 2, 4):
            bench.run(f"{workers}", workers=workers, **fields)

        assert len(bench.lines("1")) == 6
        assert bench.lines("1") == bench.lines("2") == bench.lines("4")
