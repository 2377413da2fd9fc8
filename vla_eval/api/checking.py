"""`vla_eval.check_policy`: `mikasa-vla check` from Python, also for a policy that is a Python object."""

from typing import Any  # a policy is whatever the user gives

from vla_eval.cli.check import DEFAULT_TASK
from vla_eval.policies.entries import load_policy_entry
from vla_eval.policies.given import given_entry
from vla_eval.strict.calls import public
from vla_eval.testing.check_recipe import check_recipe


@public
def check_policy(policy: Any, *, task: str = DEFAULT_TASK) -> list[str]:
    """Check without a simulator whether a policy keeps its contract; return the requirements that are met.

    Args:
        policy: as for `evaluate`: a name, an instance, a class, or a function that makes one.
        task: whose cameras, states and actions it gets.

    Raises:
        ConformanceError: a requirement is not met; the message names it.
        VlaEvalError: there is no such policy or task, or the task does not have what the policy reads.
    """
    entry = load_policy_entry(policy) if isinstance(policy, str) else given_entry(policy)
    return check_recipe(entry, task=task, report=lambda _: None, say=print)
