"""Does a policy that is named as `eval` takes it fulfil the contract? Without a simulator.

Most policies are given noise. A privileged one reads the true state of the world, which noise is not: it is
given what the fake simulator shows while the arm holds still.
"""

from collections.abc import Callable
from dataclasses import replace

from vla_eval.config.environment import EnvSettings
from vla_eval.config.evaluation import EvalConfig
from vla_eval.core import Observation
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import ConformanceError
from vla_eval.evaluation.plan import make_plan
from vla_eval.evaluation.resolve import ResolvedEvaluation
from vla_eval.evaluation.worker import make_policy
from vla_eval.models.shared.sentence_reading import ReadingPolicy, SentenceWatch
from vla_eval.policies.entries import PolicyEntry
from vla_eval.tasks.catalog import robot_task
from vla_eval.testing.check_policy import check_policy

N_SLOTS = 2  # as many episodes as the check runs side by side


def check_recipe(
    policy: PolicyEntry,
    *,
    task: str,
    report: Callable[[str], None],
    say: Callable[[str], None] = lambda _line: None,
) -> list[str]:
    """Check the policy, given what `task` shows; return and `report` what is met, `say` the rest."""
    robot_task(task, does="`check` gives a policy the observations of")
    config = EvalConfig(
        name="check",
        tasks=(task,),
        policies=policy.texts[:1],
        episodes=1,
        slots_per_worker=N_SLOTS,
        simulator="fake",
    )
    plan = make_plan(ResolvedEvaluation.of(config, [policy]))
    for line in (*(f"warning: {one}" for one in plan.warnings), *(f"note: {one}" for one in plan.notes)):
        say(line)
    group = plan.jobs[0].group
    shown = _Shown(replace(group.env, cameras=(), privileged=True))
    first = make_policy(group)
    made = [first]  # given to the check first: weights take long to load
    met = check_policy(
        lambda: made.pop() if made else make_policy(group),
        group.offered,
        observe=shown.observe if first.spec.privileged else None,
        instruction=group.instruction,
        report=report,
    )
    watch = SentenceWatch(group.part)
    readings = first.readings.values() if isinstance(first, ReadingPolicy) else ()
    for reading in (one for one in readings if one.sentence == group.instruction):
        for line in watch.lines(reading, group.key.task):
            say(f"warning: {line}")
    return met


class _Shown:
    """What the fake simulator shows of an episode in which the arm holds still."""

    def __init__(self, settings: EnvSettings) -> None:
        self._settings = settings
        self._seen: dict[int, list[Observation]] = {}
        self.spec = FakeEnv(settings).spec

    def observe(self, seed: int, step: int) -> Observation:
        """Return the observation after so many control steps."""
        if seed not in self._seen:
            env = FakeEnv(self._settings)
            results = [env.reset({0: seed}, render=False)[0]]
            for _ in range(self.spec.horizon_steps):
                results.append(env.step({0: env.hold_action(0)}, render=frozenset())[0])
            self._seen[seed] = [result.observation for result in results]
        seen = self._seen[seed]
        if step >= len(seen):
            raise ConformanceError(
                f"the check needs step {step}, but an episode of {self.spec.task} has {len(seen) - 1} steps. "
                f"Name a task with a longer episode with --task."
            )
        return seen[step]
