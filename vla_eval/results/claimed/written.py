"""What a test of a claim says, before it and after it."""

import json
from dataclasses import asdict

from vla_eval.config.evaluation import EvalConfig
from vla_eval.results.claimed.acceptance import Acceptance, Claim, Decision
from vla_eval.results.claimed.claims import Claimed
from vla_eval.results.printed_table import p_text


def render_plan(
    claimed: Claimed, test: Acceptance, config: EvalConfig, *, power: float, at_end: int | None
) -> str:
    """Return what is going to be run, and what it can tell; `at_end`: of a test that looks once."""
    k = f", K={claimed.n_action_steps}" if claimed.n_action_steps else ""
    low, high = test.claim.bounds(test.level / 2)
    once = "" if at_end is None else f" A test that looks once, at the end, takes {at_end}."
    lines = [
        f"Claim: {test.claim} of {claimed.of}; the rate behind it is between {low:.2f} and {high:.2f}.",
        f"Run: {config.policies[0]} on {claimed.task}{k}, at most {config.episodes} episodes from seed "
        f"{config.seed_start:,}, until it is decided.{once}",
        f"As good as claimed, it is accepted with probability {power:g}; having lost {test.loss:g}, with "
        f"{test.level:g} at most.",
        *(f"note: {note}" for note in claimed.notes),
    ]
    return "\n".join(lines)


def render_decision(
    decision: Decision, claimed: Claimed, test: Acceptance, config: EvalConfig, style: str
) -> str:
    """Return the verdict as a sentence (`markdown`), or all of it as `json`."""
    if style == "json":
        return json.dumps(_json(decision, claimed, test, config), indent=2)
    if not decision.n_episodes:
        return "Not decided: no episode has a result."
    found = Claim(n_success=decision.n_success, n_episodes=decision.n_episodes)
    after = f"{found} against {test.claim}"
    if decision.verdict == "reproduced":
        return f"Reproduced within {test.loss:g}: {after}."
    if decision.p_value is not None:  # below the claim
        return f"Below the claim: {after}, {p_text(decision.p_value)}."
    return f"Not decided after {decision.n_episodes} episodes: {after}."


def _json(decision: Decision, claimed: Claimed, test: Acceptance, config: EvalConfig) -> dict[str, object]:
    return {
        **decision._asdict(),
        "claim": {**asdict(test.claim), "of": claimed.of, "notes": list(claimed.notes)},
        "task": claimed.task,
        "n_action_steps": claimed.n_action_steps,
        "policy": config.policies[0],
        "loss": test.loss,
        "level": test.level,
        "floor": test.floor,
        "bar": test.bar,
        "most_episodes": config.episodes,
        "seed_start": config.seed_start,
    }
