"""One task as a Gymnasium environment: numpy, an episode per seed, with what an evaluation gives to a policy.

Knows nothing of policies. `vla_eval.tasks.register` names it to Gymnasium, `docs/gymnasium.md` explains it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, get_args  # values of observations and infos, arguments of tasks

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.config.environment import EnvSettings, RenderSettings, Simulator, WristMesh
from vla_eval.config.prompts import DEFAULT_PROMPT_SET, instruction_for
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.core import EpisodeStart, FloatArray, SimEnv, StepResult
from vla_eval.envs.factory import describe_env
from vla_eval.envs.factory import make_env as make_sim_env
from vla_eval.errors import InvalidActionError, TaskArgumentError, check_names
from vla_eval.features import FPS, IMAGE_SIZE_PX
from vla_eval.robots.find import control_mode_of
from vla_eval.strict.calls import public
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import CAMERA_NAMES, IMAGE_SIZE
from vla_eval.tasks.spec import TaskSpec

SLOT = 0  # one episode at a time
RGB_ARRAY = "rgb_array"
ONLY_MANISKILL = (
    *("num_envs", "obs_mode", "reward_mode", "sim_backend", "sensor_configs", "sim_config", "shader_dir"),
    *("human_render_camera_configs", "viewer_camera_configs", "reconfiguration_freq", "enable_shadow"),
    *("enhanced_determinism", "parallel_in_single_scene"),
)
"""Arguments of ManiSkill's environments, which scripts gave to this id before it was this environment."""


class TaskEnv(gym.Env[dict[str, Any], NDArray[Any]]):
    """Episodes of one task, one at a time.

    Observation: `images`, camera name -> (H, W, 3) uint8 RGB; `state`, name -> (D,) float32. Action: (A,)
    float32 of the control mode; what lies beyond the bounds is clipped. Info: `instruction` (not in the
    observation: `AsyncVectorEnv` does not pass text on); `phase` (`cue`, `delay`, `response`; None where the
    task does not show it); `success` and `fail` at this step; `seed`.
    `terminated`: the first success, or the episode is lost; `truncated`: the task's horizon. The simulator
    is built at the first reset: in the process that needs it.

    Attributes:
        offered: cameras, states, action and horizon of the task.
    """

    metadata = {"render_modes": [RGB_ARRAY], "render_fps": FPS}  # noqa: RUF012  gymnasium declares it so

    def __init__(
        self,
        settings: EnvSettings,
        *,
        prompt_set: str = DEFAULT_PROMPT_SET,
        render_mode: str | None = RGB_ARRAY,
    ) -> None:
        row = task_spec(settings.task)
        self.offered = offered = describe_env(settings)
        self.render_mode = render_mode
        self._settings = settings
        self._env: SimEnv | None = None
        self._result: StepResult | None = None
        self._episode = self._next = EpisodeStart(
            slot=SLOT,
            task=row.id,
            seed=0,
            run=0,
            instruction=instruction_for(row, prompt_set),
            horizon_steps=offered.horizon_steps,
        )
        images: dict[str, gym.Space[Any]] = {
            camera.name: gym.spaces.Box(0, 255, (camera.height_px, camera.width_px, 3), np.uint8)
            for camera in offered.cameras
            if camera.name in settings.cameras
        }
        states: dict[str, gym.Space[Any]] = {
            state.name: gym.spaces.Box(-np.inf, np.inf, (len(state.dims),), np.float32)
            for state in offered.states
        }
        self.observation_space = gym.spaces.Dict(
            {"images": gym.spaces.Dict(images), "state": gym.spaces.Dict(states)}
        )
        low, high = (np.array(bound, np.float32) for bound in (offered.action.low, offered.action.high))
        self.action_space = gym.spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episode that an evaluation has for a seed.

        Without a seed: the one that follows from the seed given last, or any; `info["seed"]` says which.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31)) if seed is None else self._seed_of(seed)
        if self._env is None:
            self._env = make_sim_env(self._settings)
        self._result = result = self._env.reset({SLOT: drawn}, render=bool(self._settings.cameras))[SLOT]
        self._episode = replace(self._next, seed=drawn).worded(result.wording)
        return self._observation(result), self._info(result)

    def step(self, action: NDArray[Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute one control step.

        Raises:
            InvalidActionError: not (A,) finite numbers.
        """
        if self._env is None:
            raise gym.error.ResetNeeded(f"{self._episode.task}: call reset() before step().")
        render = frozenset({SLOT} if self._settings.cameras else ())
        self._result = result = self._env.step({SLOT: self._checked(action)}, render=render)[SLOT]
        return (
            self._observation(result),
            float(result.reward),
            result.status.success or result.status.fail,
            result.observation.step >= self.offered.horizon_steps,
            self._info(result),
        )

    def render(self) -> NDArray[np.uint8]:
        """Return the first camera's last image, (H, W, 3)."""
        if self._result is None:
            raise gym.error.ResetNeeded(f"{self._episode.task}: call reset() before render().")
        return self._result.observation.images[self._settings.cameras[0]].copy()

    def hold_action(self) -> FloatArray:
        """Return the (A,) action that moves nothing."""
        if self._env is None:
            raise gym.error.ResetNeeded(f"{self._episode.task}: call reset() before hold_action().")
        return self._env.hold_action(SLOT)

    def close(self) -> None:
        """Release the simulator."""
        if self._env is not None:
            self._env.close()
            self._env = self._result = None

    def _seed_of(self, seed: int) -> int:
        """Return the episode's seed for the one that is given to `reset`."""
        return seed

    def _observation(self, result: StepResult) -> dict[str, Any]:
        seen = result.observation
        return {
            "images": {name: seen.images[name].copy() for name in self._settings.cameras},
            "state": {name: values.copy() for name, values in seen.state.items()},
        }

    def _info(self, result: StepResult) -> dict[str, Any]:
        status = result.status
        episode = {"instruction": self._episode.instruction, "seed": self._episode.seed}
        return {**episode, "phase": status.phase, "success": status.success, "fail": status.fail}

    def _checked(self, action: NDArray[Any]) -> FloatArray:
        numbers = np.asarray(action, dtype=np.float32)
        if numbers.shape != self.action_space.shape or not np.isfinite(numbers).all():
            raise InvalidActionError(
                f"{self._episode.task}: expected an action of {len(self.offered.action.dims)} finite numbers "
                f"({', '.join(self.offered.action.dims)}; {self.offered.action.control_mode}), found "
                f"{numbers.tolist()!s:.200}, of shape {numbers.shape}."
            )
        return numbers


@public
def make_env(
    task: str,
    *,
    control_mode: str | None = None,
    image_size: int = IMAGE_SIZE_PX,
    cameras: Sequence[str] = CAMERA_NAMES,
    prompt_set: str = DEFAULT_PROMPT_SET,
    render_mode: str | None = RGB_ARRAY,
    simulator: Simulator = "maniskill",
    wrist_mesh: WristMesh = "shipped",
    render_backend: str = "auto",
    **env: Any,
) -> TaskEnv:
    """Return a task's environment: what `gymnasium.make("vla_eval/TASK", …)` makes, without its wrappers.

    Args:
        task: task id, a family with the arguments that it asks for, or a task of an installed package.
        control_mode: what an action means; None: the first mode of the robot.
        image_size: height and width of images.
        cameras: which images an observation has; none: no renderer is started.
        prompt_set: where the instruction comes from.
        render_mode: `rgb_array`, or None.
        simulator: `fake` has no physics.
        wrist_mesh: see `RenderSettings`.
        render_backend: likewise.
        **env: arguments of the task, `horizon_steps` among them, as `--set env.NAME` of an evaluation.

    Raises:
        TaskArgumentError: the task does not take these arguments.
        UnknownNameError: there is no such task, argument, camera or control mode.
    """
    row = task_spec(task)
    _refuse_maniskill(row, {**env, "render_backend": render_backend})
    check_names("camera", cameras, CAMERA_NAMES, where=row.id)
    mode = control_mode_of(env) if control_mode is None else control_mode
    settings = EnvSettings(
        task=row.id,
        kwargs={**env, CONTROL_MODE: mode, IMAGE_SIZE: image_size},
        simulator=simulator,
        render=render_settings(wrist_mesh, render_backend),
        cameras=tuple(cameras),
    )
    return TaskEnv(settings, prompt_set=prompt_set, render_mode=render_mode if cameras else None)


def _refuse_maniskill(row: TaskSpec, given: Mapping[str, Any]) -> None:
    """Refuse what only ManiSkill's environment takes, which had this id before."""
    found = [name for name in ONLY_MANISKILL if name in given]
    if given["render_backend"] == "none":
        found.append("render_backend='none'")
    if found:
        raise TaskArgumentError(
            f"{row.gym_id}: {', '.join(found)}: this environment runs one episode at a time, in numpy, as an "
            f"evaluation does. ManiSkill's own environment (batched, torch) takes these arguments: "
            f'gymnasium.make("{row.maniskill_id}", …). Several episodes on a CPU: {row.make_vec(n_envs=2)}. '
            "See docs/gymnasium.md."
        )


def render_settings(wrist_mesh: str, backend: str) -> RenderSettings:
    """Return how images are rendered; raise `UnknownNameError` for a mesh that does not exist."""
    check_names("mesh", [wrist_mesh], get_args(WristMesh), where="wrist_mesh")
    return RenderSettings(wrist_mesh=cast("WristMesh", wrist_mesh), backend=backend)
