"""Conformance checks for environments, policies, tasks and policy servers, for us and for third parties.

Each check raises `ConformanceError` with the requirement that is violated. If it returns, all requirements
are met. The checks need no test framework:

    from vla_eval.testing import check_env, check_policy, check_remote, check_task

    check_env(lambda: make_my_env())
    check_policy(lambda: make_my_policy(), env_spec)
    check_task("RememberColor3-v0")
    check_remote("ws://127.0.0.1:8000")
"""

from vla_eval.testing.check_env import check_env
from vla_eval.testing.check_policy import check_policy
from vla_eval.testing.check_remote import check_remote
from vla_eval.testing.check_task import check_task

__all__ = ["check_env", "check_policy", "check_remote", "check_task"]
