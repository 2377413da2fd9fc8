"""What the loop needs to know about a type of LeRobot policy: by its configuration and its family's row."""

from typing import Any  # lerobot is untyped

from vla_eval.errors import SpecMismatchError
from vla_eval.models.families import family_of


def asked_for_steps(kind: str | None) -> bool:
    """Whether policies of a type are asked for one action at a time, see `select_step`."""
    return bool(family_of(str(kind)).queues)


def check_compiled(kind: str, *, policy: str) -> None:
    """Refuse to compile the network of a type that is known not to gain by it."""
    family = family_of(kind)
    why_not = family.not_compiled or ("it is asked for one action at a time" if family.queues else "")
    if why_not:
        raise cannot_compile(kind, why_not, policy=policy)


def cannot_compile(kind: str, why_not: str, *, policy: str) -> SpecMismatchError:
    """Return the error of a policy whose network is not compiled."""
    return SpecMismatchError(
        f"policy '{policy}': the network of a '{kind}' is not compiled: {why_not}. Leave `compile` out."
    )


def chunk_size(config: Any) -> int:
    """Return how many actions a chunk has from the observed step on; earlier ones are of no use.

    `n_action_steps` of the configuration is set to that where lerobot cuts the chunk by it: π0-FAST would
    even read the tokens of a whole chunk as those of a shorter one.
    """
    if asked_for_steps(config.type):
        return 1  # whatever its own queue holds
    deltas = config.action_delta_indices
    if not deltas:
        raise SpecMismatchError(
            f"a LeRobot policy of type '{config.type}' does not predict chunks of actions "
            f"(action_delta_indices is {deltas}). This adapter runs policies that do."
        )
    n_actions = sum(int(delta) >= 0 for delta in deltas)
    if family_of(config.type).cuts_chunk:
        config.n_action_steps = n_actions
    return n_actions


def noise_shape(config: Any) -> tuple[int, int] | None:
    """Return the shape of one episode's noise for policies that take it from outside; None for others."""
    own = getattr(config, "noise_shape", None)
    if own is not None:
        return (int(own[0]), int(own[1]))
    noise = family_of(config.type).noise
    if noise == "flow":
        return (int(config.chunk_size), int(config.max_action_dim))
    if noise == "ddim" and config.noise_scheduler_type == "DDIM":  # DDPM draws at every step
        return (int(config.horizon), int(config.action_feature.shape[0]))
    return None


def history(config: Any) -> tuple[int, ...]:
    """Return which frames it reads in time, 0 being the newest; none: the newest, without an axis of time.

    Of a policy that is trained to foresee (its indices reach beyond 0) that is the newest, as lerobot's
    own loop gives it.
    """
    if asked_for_steps(config.type):
        return ()  # it collects the others itself
    # A policy that keeps its own history may read other frames in training than when it acts.
    deltas = getattr(config, "inference_delta_indices", config.observation_delta_indices) or ()
    return () if any(delta > 0 for delta in deltas) else tuple(int(delta) for delta in deltas)
