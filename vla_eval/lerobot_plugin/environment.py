"""Our tasks as environments of LeRobot: the names its policies expect, an episode per seed.

Knows nothing of policies. `lerobot-eval` renders every step, counts errors as failures and has
no seeds in its results. For figures use `mikasa-vla eval`.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast  # lerobot and gymnasium's vector environments are untyped here

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import _LazyAsyncVectorEnv, freeze_after_episode_end

from vla_eval.config.environment import EnvSettings
from vla_eval.core import StepResult
from vla_eval.envs.gymnasium_env import TaskEnv, render_settings
from vla_eval.errors import RecipeError, SpecMismatchError, check_names
from vla_eval.features import (
    ACTION_KEY,
    CAMERA_KEYS,
    FPS,
    STATE_KEY,
    STATE_NAMES,
    StateKind,
    proprioception,
    state_names,
)
from vla_eval.robots.find import robot_of_spec
from vla_eval.specs import EnvSpec
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import task_spec

PIXELS, AGENT_POS = "pixels", "agent_pos"
CAMERA_NAMES = {camera: key.rpartition(".")[2] for camera, key in CAMERA_KEYS.items()}
"""Camera of the environment -> name under `pixels`; lerobot puts `observation.images.` before it."""
SUITE = "mikasa"


class MikasaGym(TaskEnv):
    """One task as a Gymnasium environment, under the names that lerobot reads.

    Observation: `pixels` with `base` and `wrist`, (H, W, 3) uint8 RGB, of 128 pixels or the argument
    `image_size`; `agent_pos`, (10,) or (25,) float32, as the recorder computes it. Action: float32, by
    default (7,) in [-1, 1] of `pd_ee_delta_pose`; the argument `control_mode` chooses another.
    `is_success` is in each step's info. Its episodes are those of `TaskEnv`.

    Args:
        state: which proprioception `agent_pos` is.
        prompt_set: where the instruction comes from.
        seed_offset: added to the seeds that LeRobot gives.
    """

    def __init__(
        self, settings: EnvSettings, *, state: StateKind, prompt_set: str, seed_offset: int = 0
    ) -> None:
        super().__init__(settings, prompt_set=prompt_set)
        self._state, self._seed_offset = state, seed_offset
        self.task = self._next.task
        self.task_description = self._next.instruction
        self._arm = robot_of_spec(self.offered)
        self._max_episode_steps = self.offered.horizon_steps
        image = gym.spaces.Box(0, 255, _image_shape(self.offered), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                PIXELS: gym.spaces.Dict(dict.fromkeys(CAMERA_NAMES.values(), image)),
                AGENT_POS: gym.spaces.Box(-np.inf, np.inf, (len(state_names(self._arm)[state]),), np.float32),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episode of a seed; without one, of the next that follows from the last one given.

        Raises:
            SpecMismatchError: no seed was ever given: the episode could not be reproduced.
        """
        if seed is None and self._np_random is None:
            raise SpecMismatchError(
                f"{self.task}: reset without a seed. An episode is a function of its seed; give lerobot one "
                "with --seed."
            )
        return super().reset(seed=seed, options=options)

    def _seed_of(self, seed: int) -> int:
        return seed + self._seed_offset

    def _observation(self, result: StepResult) -> dict[str, Any]:
        seen = result.observation
        return {
            PIXELS: {name: seen.images[camera].copy() for camera, name in CAMERA_NAMES.items()},
            AGENT_POS: proprioception(seen.state, self._arm)[self._state].astype(np.float32),
        }

    def _info(self, result: StepResult) -> dict[str, Any]:
        return {"is_success": result.status.success}


def _image_shape(offered: EnvSpec) -> tuple[int, int, int]:
    camera = offered.cameras[0]
    return (camera.height_px, camera.width_px, 3)


def _features(state: StateKind, offered: EnvSpec) -> dict[str, PolicyFeature]:
    images = {f"{PIXELS}/{name}": _image_shape(offered) for name in CAMERA_NAMES.values()}
    n_state = len(state_names(robot_of_spec(offered))[state])
    return {
        ACTION_KEY: PolicyFeature(type=FeatureType.ACTION, shape=(len(offered.action.dims),)),
        AGENT_POS: PolicyFeature(type=FeatureType.STATE, shape=(n_state,)),
        **{name: PolicyFeature(type=FeatureType.VISUAL, shape=shape) for name, shape in images.items()},
    }


def _features_map() -> dict[str, str]:
    images = {f"{PIXELS}/{CAMERA_NAMES[camera]}": key for camera, key in CAMERA_KEYS.items()}
    return {ACTION_KEY: ACTION_KEY, AGENT_POS: STATE_KEY, **images}


@EnvConfig.register_subclass("mikasa")
@dataclass
class MikasaEnvConfig(EnvConfig):  # type: ignore[misc]  # lerobot is untyped
    """`--env.type=mikasa`; draccus reads it, hence no frozen dataclass.

    Raises:
        RecipeError: several tasks at once in threads, which would share one policy and its queue of actions.
        UnknownNameError: there is no such task or kind of state.
    """

    task: str | None = "RememberColor3-v0"  # task id, or several with commas between them
    fps: int = FPS
    state: str = "eef"  # which proprioception `observation.state` is: `eef` (10) or `joints` (25)
    prompt_set: str = "paper"  # name in `prompts/`
    seed_offset: int = 0  # added to lerobot's seeds, which otherwise begin with its `--seed`
    # arguments of the task, `horizon_steps`, `control_mode` and `image_size` among them
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    # `simulator`, `sim_backend`, `wrist_mesh`, `render_backend`: see `EvalConfig`
    simulator: str = "maniskill"
    sim_backend: str = "cpu"
    wrist_mesh: str = "shipped"
    render_backend: str = "auto"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=_features_map)

    def __post_init__(self) -> None:
        if self.max_parallel_tasks != 1:
            raise RecipeError(
                f"env.max_parallel_tasks is {self.max_parallel_tasks}, expected 1: lerobot 0.6.1 would give "
                "the tasks' threads one policy, whose queue of actions then serves the wrong task."
            )
        for task in self._tasks():
            task_spec(task)
        if not self.features:
            offered = offered_by(task_spec(self._tasks()[0]), self.env_kwargs)
            self.features = _features(_state_kind(self.state), offered)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `create_envs` does not go through Gymnasium's registry."""
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv[Any, Any, Any]]]:
        """Return suite -> number of the task -> vector of `n_envs` environments.

        A finished episode stays as it is until lerobot begins the next one. lerobot's default begins it
        at once, so that its first reward, and its success, count for the episode before.
        """
        return {
            SUITE: {
                index: _vector(self._maker(task), n_envs, in_processes=use_async_envs and n_envs > 1)
                for index, task in enumerate(self._tasks())
            }
        }

    def _tasks(self) -> list[str]:
        return [task.strip() for task in (self.task or "").split(",")]

    def _maker(self, task: str) -> Callable[[], MikasaGym]:
        settings = EnvSettings(
            task=task_spec(task).id,
            kwargs=dict(self.env_kwargs),
            simulator=self.simulator,  # type: ignore[arg-type]  # draccus knows no Literal; `make_env` checks
            sim_backend=self.sim_backend,  # type: ignore[arg-type]  # likewise
            render=render_settings(self.wrist_mesh, self.render_backend),
            cameras=tuple(CAMERA_NAMES),
        )
        return functools.partial(
            MikasaGym,
            settings,
            state=_state_kind(self.state),
            prompt_set=self.prompt_set,
            seed_offset=self.seed_offset,
        )


def _state_kind(name: str) -> StateKind:
    check_names("kind of state", [name], STATE_NAMES, where="env.state")
    return cast("StateKind", name)


def _vector(make: Callable[[], MikasaGym], n_envs: int, *, in_processes: bool) -> Any:
    if in_processes:
        one = make()  # has its spaces without a simulator
        return _LazyAsyncVectorEnv([make] * n_envs, one.observation_space, one.action_space, one.metadata)
    return gym.vector.SyncVectorEnv(
        [freeze_after_episode_end(make)] * n_envs, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP
    )
