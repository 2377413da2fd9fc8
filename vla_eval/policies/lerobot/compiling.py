"""The network of a LeRobot policy, compiled by torch: the same computation in fewer and larger kernels.

A compiled network rounds differently, so `warm_up` compares its actions with those of the network as it is.
Kernels are chosen without timing them and draw the same random numbers: on machines of one kind an episode
has the same actions each time. On a GPU a pass is replayed from CUDA graphs. They belong to a thread, so a
policy is warmed up in the thread that asks it.
"""

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any  # lerobot is untyped

import numpy as np
import torch
from torch import Tensor
from torch._functorch import config as functorch_config
from torch._inductor.cpu_vec_isa import pick_vec_isa

from vla_eval.checkpoints.policy_types import cannot_compile, check_compiled
from vla_eval.core import EpisodeStart, FloatArray, Observation, ObservationWindow, Policy
from vla_eval.errors import SpecMismatchError
from vla_eval.lock.switch import own_need
from vla_eval.models.episodes.memory import remembers
from vla_eval.models.families import family_of
from vla_eval.policies.compiled import Compilation
from vla_eval.policies.lerobot.device import cuda_devices
from vla_eval.specs import EnvSpec
from vla_eval.wire.noise import noise_image, noise_state

MAX_SHAPES = 64
"""How many shapes of inputs a network is compiled for: some policies pad sentences to the longest one."""
OPTIONS = {
    "deterministic": True,  # no kernel is chosen by its time
    "fallback_random": True,  # torch's own draws
    # The two start programs that the lock refuses (docs/security.md): `openssl`, and Python for a pool.
    "cpp_cache_precompile_headers": False,
    "compile_threads": 1,
    "fx_graph_cache": False,  # files that are unpickled
}
SENTENCE = "pick the cube"  # of a warm-up, where none is known
SLOT = 0


def compile_network(loaded: Any, *, policy: str) -> None:
    """Let a loaded policy compile its network in its first pass; raise `SpecMismatchError` if it cannot."""
    network, config = loaded.policy, loaded.config
    check_compiled(config.type, policy=policy)
    if remembers(network):
        raise cannot_compile(config.type, "it has a memory", policy=policy)
    options: dict[str, Any] = {**OPTIONS}
    if cuda_devices(config.device):
        options["triton.cudagraphs"] = True
    with own_need():  # it tries in a process of its own which vectors the processor knows, and keeps that
        pick_vec_isa()
    family = family_of(config.type)
    if family.traced_positions:
        keep_positions(_part(network, family.traced_positions.split(".")))
    for path in family.compiled:
        *parents, name = path.split(".")
        owner = _part(network, parents)
        made = torch.compile(getattr(owner, name), dynamic=False, options=options)
        setattr(owner, name, _guarded(made, policy))


def keep_positions(embeddings: Any) -> None:
    """Let a vision model's embeddings look up the positions of patches once per shape of its images.

    SmolVLM picks the patches that a mask shows, and torch cannot trace how many these are: ten graphs in the
    place of one. LeRobot gives no mask, so that all patches are shown, at the same positions each time.
    """
    forward = embeddings.forward
    known: dict[tuple[torch.Size, torch.dtype], Tensor] = {}

    def run(pixel_values: Tensor, patch_attention_mask: Tensor) -> Tensor:
        key = (pixel_values.shape, pixel_values.dtype)
        if key in known:
            patches = embeddings.patch_embedding(pixel_values).flatten(2).transpose(1, 2)
            embedded: Tensor = patches + embeddings.position_embedding(known[key])
            return embedded
        if torch.compiler.is_compiling():
            unknown: Tensor = forward(pixel_values, patch_attention_mask)
            return unknown
        kept = embeddings.position_embedding.register_forward_pre_hook(
            lambda _, args: known.update({key: args[0]})
        )
        with kept:
            first: Tensor = forward(pixel_values, patch_attention_mask)
        return first

    embeddings.forward = run


def _part(network: Any, names: Sequence[str]) -> Any:
    return functools.reduce(getattr, names, network)


def begin_pass(device: str) -> None:
    """Let CUDA graphs use the memory of the pass before again."""
    if cuda_devices(device):
        mark: Any = torch.compiler.cudagraph_mark_step_begin
        mark()


def _guarded(compiled: Callable[..., Any], policy: str) -> Callable[..., Any]:
    """Return the function with plain errors; torch would run a network uncompiled after too many shapes."""
    changes = {"recompile_limit": MAX_SHAPES, "fail_on_recompile_limit_hit": True}

    def run(*args: Any, **kwargs: Any) -> Any:
        try:
            no_pickles = functorch_config.patch(enable_autograd_cache=False)
            with torch._dynamo.config.patch(**changes), no_pickles:
                return compiled(*args, **kwargs)
        except torch._dynamo.exc.FailOnRecompileLimitHit as exc:
            raise SpecMismatchError(
                f"policy '{policy}': its network was compiled for {MAX_SHAPES} shapes of inputs and met one "
                "more. Evaluate tasks with sentences of fewer lengths, or leave `compile` out."
            ) from exc
        except torch._dynamo.exc.TorchDynamoException as exc:
            said = " ".join(str(exc).split())
            raise SpecMismatchError(
                f"policy '{policy}': its network cannot be compiled here: {said:.300} torch needs a C++ "
                "compiler (apt-get install g++), and triton on a GPU. Or leave `compile` out."
            ) from exc

    return run


def warm_up(
    policy: Policy, env: EnvSpec, sentences: Sequence[str], *, n_rows: int, precision: str
) -> Compilation:
    """Ask a policy once for each sentence, with its network as it is and compiled."""
    begun = time.perf_counter()
    n_before, difference, scale = _n_graphs(), 0.0, 0.0
    for sentence in sentences or (SENTENCE,):
        with torch.compiler.set_stance("force_eager"):
            expected = _asked(policy, env, sentence)
        found = _asked(policy, env, sentence)
        difference = max(difference, float(np.abs(found - expected).max()))
        scale = max(scale, float(np.abs(expected).max()))
    if _n_graphs() == n_before:
        raise SpecMismatchError(
            f"policy '{policy.spec.name}': nothing of its network could be compiled. Leave `compile` out."
        )
    return Compilation(
        seconds=time.perf_counter() - begun,
        n_rows=n_rows,
        precision=precision,
        difference=difference,
        scale=scale,
    )


def _n_graphs() -> int:
    return int(torch._dynamo.utils.counters["stats"]["unique_graphs"])


def _asked(policy: Policy, env: EnvSpec, sentence: str) -> FloatArray:
    """Return the actions (T, A) of a first inference, on random images and states."""
    draws, spec = np.random.default_rng(0), policy.spec
    observation = Observation(
        step=0,
        images={
            camera.name: noise_image(draws, SLOT, camera.height_px, camera.width_px)
            for camera in env.cameras
            if camera.name in spec.cameras
        },
        state={one.name: noise_state(draws, SLOT, one.dims) for one in env.states if one.name in spec.states},
    )
    start = EpisodeStart(
        slot=SLOT, task=env.task, seed=0, run=0, instruction=sentence, horizon_steps=env.horizon_steps
    )
    policy.reset([start])
    return policy.act(ObservationWindow(slot=SLOT, frames=(observation,))).actions
