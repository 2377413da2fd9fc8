"""Each type of policy that LeRobot registers: tiny, from a dataset to an evaluation, or refused.

What is found is the table in docs/lerobot_policies.md: a new type, or another outcome, fails.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import draccus
import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors

from tests.checkpoints.small_checkpoints import (
    FAKE,
    context_for,
    observation,
    start,
    statistics,
    window,
    with_features,
)
from tests.training.lerobot_tiny import TINY, Tiny, lerobots_types
from vla_eval.checkpoints.loading import LoadOptions, make_empty_policy
from vla_eval.checkpoints.notes import known_chunk_size
from vla_eval.checkpoints.verify import verify_checkpoint
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.finetuning import FinetuneConfig
from vla_eval.envs.factory import make_env
from vla_eval.errors import CheckpointError, MissingDependencyError, SpecMismatchError, VlaEvalError
from vla_eval.models.families import FAMILIES, family_of
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.testing import check_policy
from vla_eval.testing.tiny_models import VOCABULARY, write_tiny_tokenizer
from vla_eval.training.finetune import finetune

DOCS = Path(__file__).parents[2] / "docs" / "lerobot_policies.md"
SHORT = {"steps": 2, "batch_size": 2, "save_every_steps": 2, "log_every_steps": 1, "num_workers": 0}
ONE_IMAGE = "no: it takes one image, the datasets have two"
ONE_KEY = "observation.image"
TRAINED_ALIKE = {"pi0", "pi0_fast", "xvla", "multi_task_dit", "vqbet"}
"""Types that take seconds and end as one in every run does: act, diffusion, pi05, smolvla or tdmpc."""
pytestmark = pytest.mark.usefixtures("no_network")


class Outcome(NamedTuple):
    """A row of the table."""

    trained: str
    evaluated: str


def table() -> dict[str, Outcome]:
    """Return the rows of the table in the docs."""
    rows = re.findall(r"^\| `(\w+)` \| (.+) \| (.+) \|$", DOCS.read_text(), flags=re.MULTILINE)
    return {
        kind: Outcome(trained, evaluated) for kind, trained, evaluated in rows if kind in lerobots_types()
    }


@contextmanager
def built(kind: str) -> Iterator[Tiny]:
    tiny = TINY.get(kind, Tiny())
    with tiny.built():
        yield tiny


def trained(kind: str, tiny: Tiny, dataset: Path, tmp_path: Path) -> Path:
    recipe = tmp_path / f"{kind}.yaml"
    recipe.write_text(f"version: 1\ndescription: tiny\nadapter: lerobot\nfinetune: {{type: {kind}}}\n")
    section: dict[str, Any] = {**SHORT, "policy": {**tiny.fields, **tiny.files(tmp_path)}}
    if tiny.tokenizer:
        # A text for each token: random weights predict any.
        section["tokenizer"] = str(write_tiny_tokenizer(tmp_path / "tokenizer", n_tokens=VOCABULARY))
    out = tmp_path / "run"
    finetune(
        FinetuneConfig(
            policy=str(recipe),
            dataset=str(dataset),
            out=str(out),
            run_seed=3,
            finetune=section,
            device="cpu",
            allow_unreplayed=True,
        )
    )
    return out


def saved_by_lerobot(kind: str, tiny: Tiny, folder: Path) -> Path:
    """Return a checkpoint of one image, as LeRobot saves it; TD-MPC takes no other name for it."""
    cls = PreTrainedConfig.get_choice_class(kind)
    fields = {**tiny.fields, **tiny.files(folder)}
    made = draccus.decode(cls, {"device": "cpu", "push_to_hub": False, **fields})
    config = with_features(made)
    image = config.input_features.pop("observation.images.base")
    config.input_features = {ONE_KEY: image, "observation.state": config.input_features["observation.state"]}
    torch.manual_seed(0)
    make_empty_policy(config).save_pretrained(folder)
    numbers = {**statistics(), ONE_KEY: statistics()["observation.images.base"]}
    for pipeline in make_pre_post_processors(config, dataset_stats=numbers):
        pipeline.save_pretrained(folder)
    return folder


def loaded(folder: Path) -> LeRobotPolicy:
    cameras = {"base_camera": ONE_KEY} if folder.name == "model" else None
    return make_lerobot(context_for(make_env(FAKE).spec), checkpoint=str(folder), cameras=cameras)


def evaluated(folder: Path) -> str:
    """Return which K an evaluation may have, of 1 and the longest chunk."""
    policy = loaded(folder)
    longest = policy.spec.chunk_size
    assert known_chunk_size("lerobot", {"checkpoint": str(folder)}, recipe=folder.name) in (None, longest)
    for n_action_steps in {1, longest}:
        settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=n_action_steps))
        (record,) = rollout(make_env(FAKE), policy, [start()], settings)
        assert record.n_inferences == -(-60 // n_action_steps)
    with pytest.raises(SpecMismatchError, match=f"chunks of {longest} actions"):
        beyond = RolloutSettings(chunking=ChunkingSpec(n_action_steps=longest + 1))
        rollout(make_env(FAKE), policy, [start()], beyond)
    return "K = 1" if longest == 1 else "K = 1 to its chunk"


def refusal(kind: str, exc: VlaEvalError) -> str:
    """Return what a message names: a package, what is on the Hub, or why the type is refused."""
    assert len(str(exc)) < 1500 and "Traceback" not in str(exc)
    if isinstance(exc, MissingDependencyError):
        (package,) = re.findall(r"'(\S+)' is required but not installed", str(exc))
        return f"needs the package {package}"
    why_not = family_of(kind).why_not
    if why_not:
        assert why_not in str(exc)
        return f"no: {why_not}"
    assert isinstance(exc, CheckpointError)
    (named,) = re.findall(r"its configuration names (.+?)\. Give", str(exc))
    return f"needs {named}"


def outcome(kind: str, dataset: Path, tmp_path: Path) -> Outcome:
    with built(kind) as tiny:
        try:
            run = trained(kind, tiny, dataset, tmp_path)
        except SpecMismatchError as exc:
            assert "one image" in str(exc)
            return Outcome(ONE_IMAGE, evaluated(saved_by_lerobot(kind, tiny, tmp_path / "model")))
        except VlaEvalError as exc:
            assert not (tmp_path / "run" / "train" / "checkpoints").exists()
            return Outcome(refusal(kind, exc), "")
        return Outcome("yes", evaluated(run))


def test_the_table_has_the_types_of_the_installed_lerobot() -> None:
    assert sorted(table()) == lerobots_types()


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if kind in TRAINED_ALIKE else ())
        for kind in lerobots_types()
    ],
)
def test_the_table_says_what_becomes_of_each_type(
    kind: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    found = outcome(kind, recorded, tmp_path)

    assert table()[kind] == Outcome(found.trained, found.evaluated or "the same")


@pytest.fixture(
    params=[
        pytest.param(kind, marks=pytest.mark.slow if kind in TRAINED_ALIKE else ())
        for kind, family in sorted(FAMILIES.items())
        if family.queues
    ]
)
def by_step(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    with built(request.param) as tiny:
        yield saved_by_lerobot(request.param, tiny, tmp_path / "model")


class TestAskedForSteps:
    @pytest.mark.slow
    def test_the_contract_is_kept_in_several_slots(self, by_step: Path) -> None:
        check_policy(lambda: loaded(by_step), make_env(FAKE).spec)

    def test_the_actions_are_those_of_lerobots_own_loop(self, by_step: Path) -> None:
        policy = loaded(by_step)
        policy.reset([start(0, seed=4), start(1, seed=5)])
        found = []
        for step in range(5):
            for slot in (0, 1):  # the other one's queues are not in the way
                chunk = policy.act(window(slot, observation(step, 40 * step + 20 * slot)))
                found += [chunk.actions] if slot == 0 else []

        own, parts = policy._loaded.policy, policy._loaded
        own.reset()
        expected = []
        for step in range(5):
            frame = policy._inputs.tensors(observation(step, 40 * step))
            episode = policy._slots[0].shown([frame], step=step, n_kept=1)
            batch = {
                **{name: part[None] for name, part in frame.items()},
                "task": [episode.start.instruction],
            }
            torch.manual_seed(episode.seed())
            expected.append(parts.postprocessor(own.select_action(parts.preprocessor(batch))).numpy())
        np.testing.assert_array_equal(np.stack(found), np.stack(expected))

    def test_verify_and_the_default_of_an_evaluation_ask_for_one_action(self, by_step: Path) -> None:
        assert verify_checkpoint(by_step, LoadOptions(device="cpu")).chunk == (1, 1, 7)
        assert load_policy_recipe(str(by_step)).value.default_n_action_steps == 1
