"""MIKASA-Base in the loop: a Gymnasium environment per slot."""

from collections.abc import Mapping
from typing import Any  # observations of Gymnasium

from vla_eval.base_tasks.env import BaseTaskEnv
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.named import as_named, native_action, spec_of
from vla_eval.config.environment import AS_DESIGNED, HUMAN_CAMERA, EnvSettings
from vla_eval.core import FloatArray, Observation, StepResult
from vla_eval.errors import SpecMismatchError, TaskArgumentError, check_names
from vla_eval.specs import EnvSpec
from vla_eval.task_state import HiddenState, TaskStatus
from vla_eval.tasks.arguments import HORIZON, check_argument
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.limits import SomeSteps


def check_base(settings: EnvSettings) -> None:
    """Refuse settings that these environments do not have."""
    row = task_spec(settings.task)
    check_names("argument", settings.kwargs, (HORIZON,), where=f"env of {row.id}")
    if HORIZON in settings.kwargs:
        check_argument(SomeSteps, settings.kwargs[HORIZON], name=HORIZON, task=row.id)
    is_on_gpu, is_altered = settings.sim_backend == "gpu", settings.appearance != AS_DESIGNED
    asked = {"sim_backend=gpu": is_on_gpu, "appearance": is_altered}
    for what, is_asked in asked.items():
        if is_asked:
            raise TaskArgumentError(f"{row.id}: {what}: MIKASA-Base has no such setting. Leave it out.")


def describe_base(settings: EnvSettings) -> EnvSpec:
    """Return what an environment offers; its spaces say it, so that the environment is made."""
    check_base(settings)
    env = _make(settings)
    try:
        return spec_of(settings.task, env)
    finally:
        env.close()


class BaseTaskSim:
    """Episodes of one task, one Gymnasium environment per slot."""

    def __init__(self, settings: EnvSettings) -> None:
        check_base(settings)
        self._settings = settings
        self._envs = {slot: _make(settings) for slot in range(settings.n_slots)}
        self.spec = spec_of(settings.task, self._envs[0])
        self._steps: dict[int, int] = {}

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the given slots."""
        results = {}
        for slot, seed in seeds.items():
            observation, _ = self._envs[slot].reset(seed=seed)
            self._steps[slot] = 0
            results[slot] = self._result(slot, observation, render=render)
        return results

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one step in each of the given slots."""
        results = {}
        for slot, action in actions.items():
            env = self._envs[slot]
            native = native_action(env.action_space, action, task=self.spec.task)
            observation, reward, terminated, _, info = env.step(native)
            self._steps[slot] += 1
            results[slot] = self._result(
                slot,
                observation,
                render=slot in render,
                reward=reward,
                is_over=terminated,
                success=bool(info.get("success", False)),
                action=action,
            )
        return results

    def hold_action(self, slot: int) -> FloatArray:
        """Raise: an environment without an arm has no action that leaves it where it is."""
        raise SpecMismatchError(
            f"{self.spec.task}: no action of this environment changes nothing, so that none can take the "
            "place of one that is late. Leave chunking.delay and chunking.first_inference_step "
            "out for it."
        )

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()

    def _result(
        self,
        slot: int,
        observation: Any,
        *,
        render: bool,
        reward: float = 0.0,
        is_over: bool = False,
        success: bool = False,
        action: FloatArray | None = None,
    ) -> StepResult:
        env, step = self._envs[slot], self._steps[slot]
        images, state = as_named(observation)
        wanted = {name: images[name] for name in self._settings.cameras} if render else {}
        if render and self._settings.shows_human_camera(step, self.spec.horizon_steps):
            picture = env.render()
            assert picture is not None
            wanted[HUMAN_CAMERA] = picture
        hidden = HiddenState(values=env.true_state()) if self._settings.privileged else None
        return StepResult(
            observation=Observation(step=step, images=wanted, state=state, privileged=hidden),
            status=TaskStatus(phase=None, success=success, is_over=is_over, has_success=env.has_success),
            reward=reward,
            executed_action=action,
        )


def _make(settings: EnvSettings) -> BaseTaskEnv:
    return make_base_task(settings.task, render_mode="rgb_array", **settings.kwargs)
