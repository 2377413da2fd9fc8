"""What the loop has to know of a type of LeRobot policy, read from its configuration.

Types of lerobot's own that are not understood from their configuration alone stand in the tables here; a
policy of your own says the same by attributes of its configuration.
"""

from typing import Any  # lerobot is untyped

from vla_eval.errors import SpecMismatchError

DETERMINISTIC = frozenset({"act"})
"""Types that draw nothing at inference; a policy of your own says so by `draws_nothing = True`."""

ASKED_FOR_STEPS = {
    "multi_task_dit": ("_queues",),
    "tdmpc": ("_queues", "_prev_mean"),
    "vqbet": ("_queues",),
}
"""Types of lerobot 0.6 whose `predict_action_chunk` reads the frames that their own `select_action` collected
-> what `reset` empties. They are asked for one action at a time; see `select_step.py`."""

CANNOT_BE_ASKED = {
    "gaussian_actor": "it has no chunks, and learns by reinforcement, not from demonstrations",
    "lingbot_va": "it keeps what it has seen and done inside its networks, for one episode at a time",
}
"""Types of lerobot 0.6 that can be asked neither for a chunk nor for a step of one of several episodes."""

CUT_THEIR_CHUNK = frozenset({"diffusion", "groot", "molmoact2", "pi0_fast"})
"""Types whose `predict_action_chunk` returns `n_action_steps` actions and no more."""


def chunk_size(config: Any) -> int:
    """Return how many actions a chunk has from the observed step on; earlier ones are of no use.

    `n_action_steps` of the configuration is set to that where lerobot cuts the chunk by it: π0-FAST would
    even read the tokens of a whole chunk as those of a shorter one.
    """
    if config.type in ASKED_FOR_STEPS:
        return 1  # whatever its own queue holds
    deltas = config.action_delta_indices
    if not deltas:
        raise SpecMismatchError(
            f"a LeRobot policy of type '{config.type}' does not predict chunks of actions "
            f"(action_delta_indices is {deltas}). This adapter runs policies that do."
        )
    n_actions = sum(int(delta) >= 0 for delta in deltas)
    if config.type in CUT_THEIR_CHUNK:
        config.n_action_steps = n_actions
    return n_actions


def wrapped_type(config: Any) -> str:
    """Return lerobot's type of a policy, or of the one to which it adds something and says so by `wraps`."""
    return str(getattr(config, "wraps", config.type))


def noise_shape(config: Any) -> tuple[int, int] | None:
    """Return the shape of one episode's noise for policies that take it from outside; None for others.

    A policy of your own says it by `noise_shape` of its configuration.
    """
    own = getattr(config, "noise_shape", None)
    if own is not None:
        return (int(own[0]), int(own[1]))
    if wrapped_type(config) in ("pi0", "pi05", "smolvla"):
        return (int(config.chunk_size), int(config.max_action_dim))
    if config.type == "diffusion" and config.noise_scheduler_type == "DDIM":  # DDPM draws at every step
        return (int(config.horizon), int(config.action_feature.shape[0]))
    return None


def history(config: Any) -> tuple[int, ...]:
    """Return which frames it reads in time, 0 being the newest; none: the newest, without an axis of time.

    Of a policy that is trained to foresee (its indices reach beyond 0) that is the newest, as lerobot's
    own loop gives it.
    """
    if config.type in ASKED_FOR_STEPS:
        return ()  # it collects the others itself
    # A policy that keeps its own history may read other frames in training than when it acts.
    deltas = getattr(config, "inference_delta_indices", config.observation_delta_indices) or ()
    return () if any(delta > 0 for delta in deltas) else tuple(int(delta) for delta in deltas)
