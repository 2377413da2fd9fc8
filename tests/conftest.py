"""For all tests: no access to the Hub; workers fork from one server; fixtures that several rooms use."""

import contextlib
import functools
import gc
import os
import shutil
import socket
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from importlib import metadata
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.tasks.sample import SAMPLED_TASKS

# Read when huggingface_hub is imported.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# Read when torch is imported. Test processes share the cores: threads that wait took half of the time.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from vla_eval.workers import start  # after the lines above
from vla_eval.workers.start import worker_context

# Asked by transformers and by diffusers when they are imported, 0.7 CPU s each.
setattr(metadata, "packages_distributions", functools.cache(metadata.packages_distributions))  # noqa: B010

gc.disable()  # while tests are collected: what a module makes stays

# Whatever the first test of a process needs: what a server did not import, each worker would.
worker_context(
    preload=(
        "vla_eval.envs.maniskill",
        "vla_eval.evaluation.worker",
        "vla_eval.policies.lerobot.policy",
        "vla_eval.data.recording.worker",
        "vla_eval.data.replaying.worker",
    )
)


_light_server, _light_preloaded = vars(forkserver.ForkServer()), dict[str, None]()


@pytest.fixture(scope="module")
def light_workers() -> Iterator[None]:
    """Fork this module's workers from a second server, which has imported neither torch nor a simulator.

    A fork of a small process takes a third of the time. A worker that needs more imports it itself.
    """
    server, others = vars(forkserver._forkserver), start._preloaded  # type: ignore[attr-defined]
    for here, kept in ((server, _light_server), (others, _light_preloaded)):
        _swap(here, kept)
    yield
    for here, kept in ((server, _light_server), (others, _light_preloaded)):
        _swap(here, kept)


@pytest.fixture(scope="module")
def in_this_process() -> Iterator[None]:
    """Let commands of this module evaluate and record in this process, where workers are not the subject."""
    from vla_eval.workers.in_process import IN_PROCESS

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vla_eval.cli.shared.cluster.LOCAL", IN_PROCESS)
        yield


def _swap(one: dict[str, Any], other: dict[str, Any]) -> None:
    before = dict(one)
    one.clear()
    one.update(other)
    other.clear()
    other.update(before)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse every connection but those of this machine's processes among themselves."""
    connect = socket.socket.connect

    def refuse(self: socket.socket, address: Any) -> None:
        if self.family != socket.AF_UNIX:
            raise AssertionError(f"a test tried to reach {address}")
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", refuse)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that takes `sampled_task` on every task of the catalogue."""
    if "sampled_task" in metafunc.fixturenames:
        metafunc.parametrize("sampled_task", SAMPLED_TASKS)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow all but every n-th case of a test that is `sampled(n)`, before markers are asked for."""
    n_seen: Counter[str] = Counter()
    for item in items:
        marker = item.get_closest_marker("sampled")
        if marker is None:
            continue
        name = item.nodeid.partition("[")[0]
        if n_seen[name] % marker.args[0]:
            item.add_marker(pytest.mark.slow)
        n_seen[name] += 1


def pytest_collection_finish() -> None:
    """Keep what is imported by now from being searched for garbage, which ManiSkill does at each reset."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def _without_what_earlier_tests_imported() -> None:
    """The same for what tests of other modules have left: it doubled the time of a reset."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Escape what is no valid Unicode: xdist could not send the report, and would end the whole session."""
    report = yield
    report.sections = [(title, _encodable(text)) for title, text in report.sections]
    failure = str(report.longrepr)
    if failure != _encodable(failure):
        report.longrepr = _encodable(failure)
    return report


def _encodable(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


@pytest.fixture(scope="session")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vla_eval.data.dataset_folder import digest_files
    from vla_eval.data.facts import DatasetFacts
    from vla_eval.data.manifest import (
        FAILED_FILE,
        MANIFEST_FILE,
        MIKASA_FOLDER,
        RECORDING_FILE,
        FailedSeed,
        RecordedEpisode,
        encode_actions,
        write_entry,
        write_lines,
    )
    from vla_eval.testing.synthetic import write_synthetic_dataset

    root = write_synthetic_dataset(
        tmp_path_factory.mktemp("recorded") / "RememberColor3-v0", n_episodes=4, n_frames=13
    )
    (root / MIKASA_FOLDER).mkdir()
    lengths = [13, 14, 15, 13]
    episodes = [
        RecordedEpisode(
            episode_index=index,
            task="RememberColor3-v0",
            task_version=1,
            env_kwargs={},
            seed=1000 + index + (index >= 2),  # 1002 failed
            instruction="look, wait, choose",
            expert="oracle",
            expert_version=1,
            cue_steps=5,
            delay_steps=5,
            n_steps=n_steps,
            success_step=n_steps,
            actions=encode_actions(np.zeros((n_steps, 7), np.float32)),
            intended_actions=None,
            states_sha256="0" * 64,
            images_sha256={},
        )
        for index, n_steps in enumerate(lengths)
    ]
    write_lines(root / MANIFEST_FILE, episodes)
    write_lines(root / FAILED_FILE, [FailedSeed(seed=1002, n_steps=60)])
    facts = DatasetFacts(
        complete=True,
        name="tiny",
        task="RememberColor3-v0",
        task_version=1,
        instruction="look, wait, choose",
        state="eef",
        n_episodes=4,
        n_frames=sum(lengths),
        n_failed_seeds=1,
        recipe={"name": "tiny", "keep": "successes", "cut": "after_success", "steps_after_success": 5},
        recipe_sha256="1" * 64,
        recipe_files={"policies/oracle": "2" * 64},
        environment={},
        device={"simulator": "fake"},
        files=digest_files(root),
    )
    write_entry(root / RECORDING_FILE, facts)
    return root


@pytest.fixture
def recorded(_recorded: Path, tmp_path: Path) -> Path:
    """Return a copy of a dataset that counts as recorded: 4 episodes of 13, 14, 15, 13 frames."""
    copy = tmp_path / "recorded" / _recorded.name
    shutil.copytree(_recorded, copy)
    return copy


@pytest.fixture
def small_act() -> Iterator[None]:
    """ACT with a small network as its vision encoder: most of a training's time went there."""
    from vla_eval.testing.tiny_models import tiny_resnet

    with tiny_resnet():
        yield


@pytest.fixture
def small_act_in_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in worker processes, which have to import lerobot for it."""
    from vla_eval.evaluation import evaluate
    from vla_eval.testing.tiny_models import TINY_RUNNER

    monkeypatch.setattr(evaluate, "RUNNER", TINY_RUNNER)


@pytest.fixture
def killed_at(
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[int], contextlib.AbstractContextManager[None]]:
    """Training stops at a step: nothing is written after the last checkpoint before, as with kill -9."""
    from vla_eval.training import loop

    class Killed(BaseException):
        pass

    @contextlib.contextmanager
    def killed(step: int) -> Iterator[None]:
        def seed_step(run_seed: int, at: int, process: int, original: Any = loop.seed_step) -> None:
            if at == step:
                raise Killed
            original(run_seed, at, process)

        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(loop, "seed_step", seed_step)
            yield

    return killed
