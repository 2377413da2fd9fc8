"""The policies of a session, each loaded once: a network that serves all stages is not loaded three times."""

from collections.abc import Callable

from vla_eval.config.files import digest_of
from vla_eval.core import Policy
from vla_eval.episode_log import check_execution
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.registry import SCRIPTED, make_from_adapter
from vla_eval.real.evaluation import RealEvaluation
from vla_eval.real.plan import PlannedEpisode
from vla_eval.specs import EnvSpec, check_compatible
from vla_eval.tasks.real_stages import COLORS, Stage


class SessionPolicies:
    """Policies by the episodes that they run."""

    def __init__(self, evaluation: RealEvaluation, offered: Callable[[Stage, PolicyEntry], EnvSpec]) -> None:
        """Load all; `offered`: what the environment of a stage offers to a policy.

        Raises:
            VlaEvalError: one cannot be loaded, or does not fit.
        """
        self._evaluation = evaluation
        self._offered = offered
        self._loaded: dict[tuple[str, str], Policy] = {}
        for planned in evaluation.plan:
            self.of(planned)

    def of(self, planned: PlannedEpisode) -> Policy:
        """Return the policy that moves the arm in an episode."""
        stage = planned.trial.stage
        entry = self._evaluation.entry(planned.policy, stage)
        # The experts of scripted policies are those of their task; a network does not know the task.
        of_stage = stage.name if entry.value.adapter in SCRIPTED else ""
        key = (entry.part(0), of_stage)
        if key not in self._loaded:
            env, chunking = self._offered(stage, entry), self._evaluation.rollout(entry).chunking
            context = PolicyContext(name=entry.name, env=env, chunking=chunking, n_candidates=len(COLORS))
            args = entry.recipes[0].value.args
            if entry.server is not None:
                args = {**args, "identity_sha256": digest_of(entry.server.identity())}
            policy = make_from_adapter(entry.value.adapter, context, args)
            check_compatible(policy.spec, env)
            check_execution(policy.spec, chunking)
            self._loaded[key] = policy
        return self._loaded[key]
