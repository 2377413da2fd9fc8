"""The adapter of the official package's environments, which has to be installed (`make suite90`).

Each slot is one official environment on the CPU simulator, reset and stepped as the official runner does,
with the no-ops of its wrapper until the choice; `true_states` makes right what is right only on the GPU
simulator. Images are rendered only on request. The official prompts and oracle information (`task_cue`,
`oracle_info`) are in no observation. Knows nothing of policies or records.
"""

import gc
import importlib
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple  # ManiSkill and the package are untyped: environments, infos are Any here

import vla_eval.envs.lean_import  # noqa: F401  first: the others import ManiSkill

# isort: split
import numpy as np
import torch

from vla_eval.config.environment import HUMAN_CAMERA, EnvSettings
from vla_eval.core import FloatArray, Observation, StepResult
from vla_eval.envs.official_assets import provide_bulb, provide_mug
from vla_eval.envs.official_settings import BULB, MUG, WITH_LAMPS, check_official
from vla_eval.envs.official_state import Choices, first_positions_m, read_bodies, read_candidates, to_vector
from vla_eval.envs.scenes import build, describe, own_views, take_human_image, take_images
from vla_eval.envs.true_states import TrueStates
from vla_eval.errors import MissingDependencyError, SpecMismatchError, TaskArgumentError, check_names
from vla_eval.oracles.arm_model import gripper_command
from vla_eval.task_state import Phase, PrivilegedState, TaskStatus
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import ACTION, CAMERAS
from vla_eval.tasks.objects.bodies import to_array, yaw_rad
from vla_eval.tasks.objects.layout import places_from_right
from vla_eval.tasks.spec import TaskSpec

PACKAGE = "mikasa_robo_suite"
ROBOT = "panda_wristcam"
LARGEST_SEED = 2**32 - 1  # of numpy's RandomState, which ManiSkill draws from

# See `maniskill.py`.
gc.freeze()


class OfficialEnv:
    """`SimEnv` on the official package; see the module docstring."""

    def __init__(self, settings: EnvSettings) -> None:
        row = task_spec(settings.task)
        check_official(settings, row)
        check_names("camera", settings.cameras, [camera.name for camera in CAMERAS], where=row.id)
        cls = _adapted(official_class(row))
        self._row, self._settings = row, settings
        self.device: dict[str, str] = {}
        if "/ShellGame" in row.id:
            self.device[MUG] = provide_mug(settings.kwargs.get(MUG, "ycb"), task=row.id)
        if settings.cameras and row.id.rpartition("/")[2].startswith(WITH_LAMPS):
            self.device[BULB] = provide_bulb(settings.kwargs.get(BULB, "package"), task=row.id)
        # A scene of its own per episode: what the simulator keeps of an earlier one moves the next.
        arm = {"control_mode": ACTION.control_mode, "robot_uids": ROBOT, "reconfiguration_freq": 1}
        self._envs = [
            build(cls, settings, num_envs=1, sim_backend="physx_cpu", **arm) for _ in range(settings.n_slots)
        ]
        self._views = own_views(settings, settings.n_slots)
        self._episodes: dict[int, OfficialEpisode] = {}
        self.device |= describe(self._envs[0], settings)
        self.spec = offered_by(row, settings.kwargs)

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the given slots; see `SimEnv.reset`."""
        return {slot: self._begin(slot, seed, render=render) for slot, seed in seeds.items()}

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one control step in each of the given slots; see `SimEnv.step`."""
        return {slot: self._advance(slot, action, render=slot in render) for slot, action in actions.items()}

    def hold_action(self, slot: int) -> FloatArray:
        """Return the (7,) action that moves nothing; see `SimEnv.hold_action`."""
        finger_m = float(self._envs[slot].agent.robot.get_qpos()[0, -2:].mean())
        action = np.zeros(len(ACTION.dims), dtype=np.float32)
        action[-1] = gripper_command(finger_m)
        return action

    def close(self) -> None:
        """Release the simulator."""
        for env in self._envs:
            env.close()
        self._envs, self._views = [], []

    def _begin(self, slot: int, seed: int, *, render: bool) -> StepResult:
        if not 0 <= seed <= LARGEST_SEED:
            raise TaskArgumentError(
                f"{self._row.id}: seed {seed}: the official environments take 0 to {LARGEST_SEED}. Choose "
                "another seed_start."
            )
        env = self._envs[slot]
        _, info = env.reset(seed=seed)
        self._episodes[slot] = OfficialEpisode(self._row, env)
        return self._result(slot, info, render=render, wording=_wording(self._row, info))

    def _advance(self, slot: int, action: FloatArray, *, render: bool) -> StepResult:
        env = self._envs[slot]
        executed = ACTION.clipped(action)
        if self._row.waits_for_choice and int(env.elapsed_steps[0]) < sum(waiting_of(env)):
            executed = np.zeros_like(executed)
        _, reward, _, _, info = env.step(torch.as_tensor(executed[None], device=env.device))
        return self._result(slot, info, render=render, reward=float(reward[0]), executed_action=executed)

    def _result(self, slot: int, info: Any, *, render: bool, **fields: Any) -> StepResult:
        episode = self._episodes[slot]
        episode.note(int(info["elapsed_steps"][0]))
        true_state = episode.true_state() if self._settings.privileged else None
        return StepResult(
            observation=self._observation(slot, info, true_state, render=render),
            status=episode.status(success=bool(info["success"][0])),
            **fields,
        )

    def _observation(
        self, slot: int, info: Any, true_state: PrivilegedState | None, *, render: bool
    ) -> Observation:
        env, views = self._envs[slot], self._views[slot]
        step, robot = int(info["elapsed_steps"][0]), env.agent.robot
        state = {"tcp_pose": env.agent.tcp.pose.raw_pose, "qpos": robot.get_qpos(), "qvel": robot.get_qvel()}
        images = {}
        if render:
            for hidden in env._hidden_objects:
                hidden.hide_visual()
            images = take_images(env, self._settings.cameras, views)
            if self._settings.shows_human_camera(step, self.spec.horizon_steps):
                images[HUMAN_CAMERA] = take_human_image(env)
        return Observation(
            step=step,
            images={name: batch[0].copy() for name, batch in images.items()},
            state={name: to_array(batch[0]) for name, batch in state.items()},
            privileged=true_state,
        )


def official_class(row: TaskSpec) -> Any:
    """Return the official class of a task."""
    part = "vla" if row.suite == "mikasa_vla_90" else "rl"
    try:
        importlib.import_module(f"{PACKAGE}.{part}.memory_envs")
    except ModuleNotFoundError as exc:
        raise MissingDependencyError(
            f"{row.id} runs in the official package, of which the module '{exc.name}' is not installed. Run "
            "`make suite90`, which installs mikasa-robo-suite 1.0.0 beside this package."
        ) from exc
    registered = importlib.import_module("mani_skill.utils.registration").REGISTERED_ENVS
    return registered[row.id.split("/", 1)[1]].cls


def _adapted(cls: Any) -> Any:
    """Return the class with its true states, and without observations of its own."""

    def get_obs(env: Any, info: Any = None, *_args: Any, **_kwargs: Any) -> dict[str, Any]:
        env._get_obs_extra(info)  # some tasks compute there what their rewards read
        return {}

    return type(cls.__name__, (TrueStates, cls), {"__module__": cls.__module__, "get_obs": get_obs})


def _wording(row: TaskSpec, info: Any) -> dict[str, str]:
    """Return the angle of a Rotate task, which the official sentence of each episode states."""
    if row.instruction is None or "{angle_deg}" not in row.instruction:
        return {}
    before, after = row.instruction.split("{angle_deg}")
    sentence = info["language_instruction"][0]
    found = re.fullmatch(rf"{re.escape(before)}(-?\d+){re.escape(after)}", sentence)
    if found is None:
        raise SpecMismatchError(
            f"{row.id}: expected the sentence '{row.instruction}', found '{sentence}'. Is another version of "
            "the official package installed? `make suite90` installs 1.0.0."
        )
    return {"angle_deg": found[1]}


class Waiting(NamedTuple):
    """The steps of an episode before the choice, as the environment has drawn them."""

    cue_steps: int
    delay_steps: int


def waiting_of(env: Any) -> Waiting:
    """Return the steps of cue and delay: drawn per episode in the 90 tasks, else constants."""
    if hasattr(env, "cue_steps_per_env"):
        delay = env.empty_steps_per_env if hasattr(env, "empty_steps_per_env") else [0]
        return Waiting(int(env.cue_steps_per_env[0]), int(delay[0]))
    if hasattr(env, "TIME_OFFSET"):
        return Waiting(int(env.TIME_OFFSET), int(getattr(env, "DELTA_TIME", 0)))
    return Waiting(int(env.STEP_DURATION), int(env.EMPTY_DURATION))


class OfficialEpisode:
    """A running episode as noted last; what is between cue and choice is a delay, also where mugs move."""

    def __init__(self, row: TaskSpec, env: Any) -> None:
        self._row, self._env = row, env
        self.phase: Phase = self._phase(0)
        self.candidates = read_candidates(row, env, revealed=False)
        self._first = first_positions_m(row, env, self.candidates)
        self._choices = Choices(row, env, self._first)

    def note(self, step: int) -> None:
        """Look at the environment, which has been evaluated after so many control steps."""
        self.phase = self._phase(step)
        revealed = self.phase == "response"
        self.candidates = read_candidates(self._row, self._env, revealed=revealed)
        if self.candidates is not None and revealed:
            self._choices.note(self.candidates)

    def _phase(self, step: int) -> Phase:
        if self._row.phase_source == "none" and not self._row.has_candidates:
            return "response"
        waiting = waiting_of(self._env)
        if step < waiting.cue_steps:
            return "cue"
        return "delay" if step < sum(waiting) else "response"

    def status(self, *, success: bool) -> TaskStatus:
        """Return what the record says of this step."""
        said = TaskStatus(phase=None if self._row.phase_source == "none" else self.phase, success=success)
        if self.candidates is None:
            return said
        target, chosen = self.candidates.target, tuple(self._choices.chosen)
        return replace(
            said,
            n_candidates=len(self.candidates.positions_m),
            n_wrong_choices=len(set(chosen) - {target}),
            right_first_choices=(target,),
            chance_success=1 / len(self.candidates.positions_m),
            candidate_places=places_from_right(self._first[:, :2]),
            right_candidates=(target,),
            touched_candidates=chosen,
        )

    def true_state(self) -> PrivilegedState | None:
        """Return what scripted controls are given; None for a task that has none."""
        row, env, candidates = self._row, self._env, self.candidates
        if row.true_state == "none":
            return None
        right = () if candidates is None else (candidates.target,)
        tcp = env.agent.tcp
        return PrivilegedState(
            phase=self.phase,
            response_step=sum(waiting_of(env)) if row.has_candidates else 0,
            tcp_position_m=to_vector(tcp.pose.p[0]),
            tcp_velocity_m_s=to_vector(tcp.linear_velocity[0]),
            gripper_width_m=float(env.agent.robot.get_qpos()[0, -2:].sum()),
            candidate_positions_m=np.zeros((0, 3)) if candidates is None else candidates.positions_m,
            right_candidates=right,
            shown_candidates=self._shown() if self.phase == "cue" else (),
            touched_candidates=tuple(self._choices.chosen),
            bodies=read_bodies(row, env, candidates, self._first),
            tcp_yaw_rad=float(yaw_rad(to_array(tcp.pose.q))[0]),
        )

    def _shown(self) -> tuple[int, ...]:
        """Return whose cue is in view while the cue is shown."""
        if self.candidates is None:
            return ()
        if self._row.cue_leaves_out:
            others = range(len(self.candidates.positions_m))
            return tuple(index for index in others if index != self.candidates.target)
        return (self.candidates.target,)
