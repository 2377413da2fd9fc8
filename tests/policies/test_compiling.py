"""A compiled network: which are, what is measured of it, what is refused, and how an evaluation says so.

Most tests let torch trace the network and run its operations as they are: a compiler takes a minute each.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers.models.smolvlm.configuration_smolvlm import SmolVLMVisionConfig
from transformers.models.smolvlm.modeling_smolvlm import SmolVLMVisionTransformer

from tests.checkpoints.small_checkpoints import (
    act,
    backbone,
    context_for,
    diffusion,
    env,
    observation,
    pi0,
    smolvla,
    start,
    window,
)
from vla_eval.checkpoints.policy_types import check_compiled
from vla_eval.errors import SpecMismatchError
from vla_eval.models.families import FAMILIES
from vla_eval.policies.compiled import Compilation, CompiledPolicy
from vla_eval.policies.lerobot import compiling
from vla_eval.policies.lerobot.paper_compat import PaperCompatPolicy
from vla_eval.policies.lerobot.policy import LeRobotPolicy, make_lerobot
from vla_eval.specs import EnvSpec
from vla_eval.testing.tiny_models import make_tiny

__all__ = ["act", "backbone", "diffusion", "env", "pi0", "smolvla"]  # fixtures


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict[str, Any]]]:
    """Trace networks, and run the graphs as they are; the list has the options that torch was given."""
    asked: list[dict[str, Any]] = []
    compile_ = torch.compile

    def trace(function: Any, *, dynamic: bool, options: dict[str, Any]) -> Any:
        asked.append({"dynamic": dynamic, **options})
        return compile_(function, dynamic=dynamic, backend="eager")

    torch._dynamo.reset()
    monkeypatch.setattr(torch, "compile", trace)
    # Which vectors the processor knows, a compiler asks: by a process that imports torch for each kind.
    monkeypatch.setattr(compiling, "pick_vec_isa", lambda: None)
    yield asked
    torch._dynamo.reset()


def made(folder: Path, env: EnvSpec, *, n_slots: int = 1, **args: Any) -> LeRobotPolicy:
    maker: Any = make_tiny if "pi0" in folder.parent.name else make_lerobot
    context = context_for(env)
    if n_slots > 1:
        context = dataclasses.replace(context, n_slots=n_slots)
    policy: LeRobotPolicy = maker(context, checkpoint=str(folder), **args)
    return policy


def actions(policy: LeRobotPolicy, *, seed: int = 1) -> np.ndarray[Any, Any]:
    policy.reset([start(seed=seed)])
    return policy.act(window(0, observation(level=40))).actions


@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("act", "diffusion")), "pi0"]
)
class TestNetwork:
    def test_a_compiled_network_computes_what_the_network_computes(
        self, kind: str, env: EnvSpec, traced: list[dict[str, Any]], request: pytest.FixtureRequest
    ) -> None:
        folder = request.getfixturevalue(kind)
        plain, compiled = made(folder, env), made(folder, env, compile=True)

        found = compiled.warm_up(env, ("touch it",))

        assert found is not None
        assert found.difference == 0  # the graphs are run by torch's own operations
        assert found.scale > 0
        np.testing.assert_array_equal(actions(compiled), actions(plain))
        assert isinstance(compiled, CompiledPolicy)
        assert plain.warm_up(env, ("touch it",)) is None

    def test_kernels_are_not_chosen_by_timing_and_draw_what_torch_draws(
        self, kind: str, env: EnvSpec, traced: list[dict[str, Any]], request: pytest.FixtureRequest
    ) -> None:
        made(request.getfixturevalue(kind), env, compile=True)

        assert traced
        for asked in traced:
            assert (asked["dynamic"], asked["deterministic"], asked["fallback_random"]) == (False, True, True)
        assert all(
            torch._inductor.config.get_config_copy().keys() >= asked.keys() - {"dynamic"} for asked in traced
        )


def test_positions_of_patches_are_traced_and_are_the_same(traced: list[dict[str, Any]]) -> None:
    sizes = {"hidden_size": 8, "intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1}
    torch.manual_seed(0)
    vision = SmolVLMVisionTransformer(SmolVLMVisionConfig(**sizes, image_size=32, patch_size=8)).eval()
    images = {size: torch.rand(2, 3, *size) for size in ((32, 32), (16, 24))}  # of another size, too
    expected = {size: vision(image).last_hidden_state for size, image in images.items()}

    compiling.keep_positions(vision.embeddings)

    run = torch.compile(lambda image: vision(image).last_hidden_state, dynamic=False, options={})
    for size, image in images.items():
        with torch.compiler.set_stance("force_eager"):
            assert torch.equal(run(image), expected[size])
        before = compiling._n_graphs()
        assert torch.equal(run(image), expected[size])
        assert compiling._n_graphs() - before == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["act", "pi0", "smolvla"])
def test_prefix_and_denoising_steps_are_one_graph(
    kind: str, env: EnvSpec, traced: list[dict[str, Any]], request: pytest.FixtureRequest
) -> None:
    plain, compiled = (made(request.getfixturevalue(kind), env, **args) for args in ({}, {"compile": True}))
    before = compiling._n_graphs()

    found = compiled.warm_up(env, ("touch it",))

    assert compiling._n_graphs() - before == 1
    assert found is not None and found.difference == 0
    np.testing.assert_array_equal(actions(compiled), actions(plain))


class TestWarmUp:
    def test_how_far_actions_are_off_is_measured_in_the_actions_units(
        self, act: Path, env: EnvSpec, traced: list[dict[str, Any]]
    ) -> None:
        policy = made(act, env, compile=True)
        before = policy._loaded.postprocessor
        policy._loaded.policy.predict_action_chunk = _shifted(policy._loaded.policy.predict_action_chunk)

        found = policy.warm_up(env, ())

        assert found is not None
        raw = torch.zeros(1, 1, 7)
        per_unit = (before(raw + 0.5) - before(raw)).abs().max().item()  # of a normalised action of 0.5
        assert found.difference == pytest.approx(per_unit, rel=1e-4)

    def test_it_counts_the_rows_of_a_pass_and_names_the_precision(
        self, act: Path, env: EnvSpec, traced: list[dict[str, Any]]
    ) -> None:
        found = made(act, env, n_slots=3, compile=True).warm_up(env, ("a", "b"))

        assert found is not None
        assert (found.n_rows, found.precision) == (3, "float32")
        assert "3 in a pass" in found.note("mine")
        assert found.seconds > 0

    def test_a_policy_of_which_nothing_is_compiled_is_refused(
        self, act: Path, env: EnvSpec, traced: list[dict[str, Any]]
    ) -> None:
        policy = made(act, env, compile=True)
        del policy._loaded.policy.predict_action_chunk  # the class's own is what is called now

        with pytest.raises(SpecMismatchError, match="nothing of its network could be compiled"):
            policy.warm_up(env, ())

    def test_a_policy_that_acts_as_the_paper_did_is_warmed_up_like_the_one_in_it(
        self, act: Path, env: EnvSpec, traced: list[dict[str, Any]]
    ) -> None:
        policy = PaperCompatPolicy(made(act, env, compile=True), ["gripper_sign"], n_action_steps=4)

        found = policy.warm_up(env, ())

        assert isinstance(policy, CompiledPolicy)
        assert found is not None and found.difference == 0

    def test_one_shape_too_many_is_an_error_and_is_not_computed_otherwise(
        self, act: Path, env: EnvSpec, traced: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(compiling, "MAX_SHAPES", 1)
        policy = made(act, env, compile=True)
        network, size = policy._loaded.policy, iter([1, 2])
        predict = network.predict_action_chunk
        network.predict_action_chunk = lambda batch: predict(_repeated(batch, next(size)))[:1]

        assert actions(policy).shape == (8, 7)
        with pytest.raises(SpecMismatchError, match="compiled for 1 shapes of inputs and met one more"):
            actions(policy)

    def test_a_compiler_that_fails_is_named_with_what_to_install(
        self, act: Path, env: EnvSpec, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fails(graph: Any, inputs: Any) -> Any:
            raise RuntimeError("no working C++ compiler")

        torch._dynamo.reset()
        compile_ = torch.compile
        monkeypatch.setattr(torch, "compile", lambda function, **_: compile_(function, backend=fails))
        monkeypatch.setattr(compiling, "pick_vec_isa", lambda: None)
        policy = made(act, env, compile=True)

        with pytest.raises(SpecMismatchError, match=r"no working C\+\+ compiler.*apt-get install g\+\+"):
            policy.warm_up(env, ())


def _shifted(function: Any) -> Any:
    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        is_eager = torch._dynamo.eval_frame._stance.stance == "force_eager"
        return function(*args, **kwargs) + (0.0 if is_eager else 0.5)

    return run


def _repeated(batch: dict[str, Any], n: int) -> dict[str, Any]:
    return {key: x.repeat_interleave(n, 0) if isinstance(x, torch.Tensor) else x for key, x in batch.items()}


class TestRefused:
    @pytest.mark.parametrize("kind", sorted(FAMILIES))
    def test_a_type_is_compiled_or_says_why_not_before_it_is_loaded(self, kind: str) -> None:
        family = FAMILIES[kind]
        if family.not_compiled or family.queues:
            with pytest.raises(SpecMismatchError, match=f"'{kind}' is not compiled: .* Leave `compile` out"):
                check_compiled(kind, policy="p")
        else:
            check_compiled(kind, policy="p")
            assert family.compiled

    def test_a_policy_with_a_memory_is_not_compiled(self, act: Path, env: EnvSpec) -> None:
        loaded = made(act, env)._loaded
        loaded.policy.remember = lambda batch, memory: None
        try:
            with pytest.raises(SpecMismatchError, match="it has a memory"):
                compiling.compile_network(loaded, policy="p")
        finally:
            del loaded.policy.remember


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["act", "pi0", "diffusion"])
def test_kernels_of_a_cpu_round_as_little_as_float32_does(
    kind: str, env: EnvSpec, request: pytest.FixtureRequest
) -> None:
    torch._dynamo.reset()
    policy = made(request.getfixturevalue(kind), env, n_slots=2, compile=True)

    found = policy.warm_up(env, ("touch it",))

    assert isinstance(found, Compilation)
    assert found.difference <= 1e-4 * found.scale
    np.testing.assert_array_equal(actions(policy), actions(policy))
