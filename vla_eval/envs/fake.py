"""A fake simulator: the same contract, arrays only. For tests and dry runs.

The tool centre point is a point that follows the actions. Candidates lie in a row. The ball of the
Intercept tasks rolls straight and moves with the point once the point reaches it. No physics, no arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.config.environment import AS_DESIGNED, HUMAN_CAMERA, EnvSettings
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.core import FloatArray, ImageArray, Observation, StepResult
from vla_eval.cue_view import CueBoxes, PixelBox
from vla_eval.envs.official_settings import check_official
from vla_eval.errors import TaskArgumentError, check_names
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots.find import control_mode_of
from vla_eval.robots.rows import PANDA
from vla_eval.specs import EnvSpec
from vla_eval.task_state import BodyState, Phase, PrivilegedState, TaskStatus
from vla_eval.tasks.arguments import check_argument, check_arguments
from vla_eval.tasks.arm.interference import GRIPPER_DIMENSION, Y_DIMENSION, delay_motion
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import ACTION, CAMERA_NAMES, CONTROL_HZ, IMAGE_SIZE, cameras, states
from vla_eval.tasks.objects.layout import places_from_right
from vla_eval.tasks.spec import TaskSpec, chance_of_several

M_PER_STEP = 0.039  # measured displacement of ManiSkill's pd_ee_delta_pose per step at action 1
TCP_START_M = (-0.07, 0.0, 0.318)
CANDIDATE_SPACING_M = 0.1
CANDIDATE_Z_M = 0.02
REACH_M = 0.05
MUG_REACH_M = 0.07  # the arm comes to rest on a mug, which is taller than a cube
STATIC_ACTION = 0.2  # the point counts as at rest if every dimension is below it
GOAL_RADIUS_M = 0.1
GRIPPER_MAX_M = 0.08
CUE_ROWS = 8  # of an image: they show the cue, or what distracts
DISTRACTOR_LEVEL = 255  # of these rows; no cue has it
RULES = {
    **{"swap_cue": 0, "show_cue": True, "freeze_until_choice": False, "strict_choice": False},
    **{"move_in_delay": False, "distract_steps": 0, "cue_after_steps": 0},
}
PHASES = ("cue_steps", "delay_steps")  # not drawn from a range here
CHOICE_DEFAULTS = {**dict.fromkeys(PHASES, 5), **RULES}
SEVERAL_DEFAULTS = {**CHOICE_DEFAULTS, "n_shown": 3, "swap_order": 0, "shuffle_cue": False}
BALL_DEFAULTS = {"velocity_range_m_s": (0.5, 0.75), "swap_cue": 0}

Vector = NDArray[np.float64]


@dataclass(slots=True, kw_only=True)
class _Episode:
    seed: int
    candidates_m: Vector
    targets: tuple[int, ...]
    ball_m: Vector
    ball_velocity_m_s: Vector
    goal_m: Vector
    step: int = 0
    tcp_m: Vector = field(default_factory=lambda: np.array(TCP_START_M))
    tcp_velocity_m_s: Vector = field(default_factory=lambda: np.zeros(3))
    gripper_width_m: float = GRIPPER_MAX_M
    is_static: bool = True
    touched: list[int] = field(default_factory=list)


class FakeEnv:
    """Implements `SimEnv` with the arguments of the defaults above; `n_renders` counts what was rendered."""

    def __init__(self, settings: EnvSettings) -> None:
        task = task_spec(settings.task)
        defaults = _defaults(task)
        if task.is_base:
            raise TaskArgumentError(
                f"simulator=fake: {task.id}: MIKASA-Base needs no simulator. Leave this field out."
            )
        if task.is_official:
            check_official(settings, task)
        else:
            check_arguments(task, settings.kwargs)
            known = ("horizon_steps", CONTROL_MODE, IMAGE_SIZE, *defaults)
            check_names("argument", settings.kwargs, known, where=task.id)
        arguments = {**defaults, **task.kwargs, **settings.kwargs}
        for name in PHASES:
            check_argument(int, arguments.get(name, 0), name=name, task=task.id)
        self._n_items = task.n_candidates(settings.kwargs)
        self._n_shown: int = arguments.get("n_shown", 1 if self._n_items else 0)
        self._in_order = task.order_counts
        self._touch_reach_m = MUG_REACH_M if task.id.startswith("ShellGame") else REACH_M
        self._speeds_m_s: tuple[float, float] = arguments.get("velocity_range_m_s", (0.0, 0.0))
        self._cue_after_steps: int = arguments.get("cue_after_steps", 0)
        self._cue_steps: int = self._cue_after_steps + arguments.get("cue_steps", 0)
        self._response_step: int = self._cue_steps + arguments.get("delay_steps", 0)
        self._swap_cue: int = arguments["swap_cue"]
        self._swap_order: int = arguments.get("swap_order", 0)
        self._shuffles_cue: bool = arguments.get("shuffle_cue", False)
        self._shows_cue: bool = arguments.get("show_cue", True)
        self._is_frozen: bool = arguments.get("freeze_until_choice", False)
        self._moves_in_delay: bool = arguments.get("move_in_delay", False)
        self._distract_steps: int = arguments.get("distract_steps", 0)
        self._is_strict: bool = arguments.get("strict_choice", False)
        if settings.appearance != AS_DESIGNED:
            raise TaskArgumentError(
                f"appearance: {task.id}: the fake simulator has no lights and no colours. Use the simulator "
                "'maniskill', or remove this setting."
            )
        if control_mode_of(settings.kwargs) != ACTION.control_mode:
            raise TaskArgumentError(
                f"{CONTROL_MODE}={control_mode_of(settings.kwargs)!r}: {task.id}: the fake simulator has no "
                f"joints and takes {ACTION.control_mode}. Use the simulator 'maniskill', or remove this."
            )
        self._image_size_px: int = arguments.get(IMAGE_SIZE, IMAGE_SIZE_PX)
        self._settings = settings
        self._episodes: dict[int, _Episode] = {}
        self.n_renders = 0
        self.device = {"simulator": "fake"}
        self.spec = EnvSpec(
            task=task.id,
            cameras=cameras(self._image_size_px),
            states=states(),
            action=ACTION,
            horizon_steps=arguments.get("horizon_steps", task.default_horizon_steps(self._response_step)),
            control_hz=CONTROL_HZ,
            robot=PANDA.name,
        )

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the given slots; see `SimEnv`."""
        self._episodes.update({slot: self._new_episode(seed) for slot, seed in seeds.items()})
        return {slot: self._result(slot, render=render) for slot in seeds}

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one control step in each of the given slots; see `SimEnv`."""
        executed: dict[int, FloatArray] = {}
        for slot, action in actions.items():
            executed[slot] = self._executed(slot, action)
            self._advance(self._episodes[slot], executed[slot].astype(np.float64))
        return {
            slot: replace(self._result(slot, render=slot in render), executed_action=executed[slot])
            for slot in actions
        }

    def _executed(self, slot: int, action: FloatArray) -> FloatArray:
        step = self._episodes[slot].step
        motion = delay_motion(step, begins=self._cue_steps, ends=self._response_step)
        if self._moves_in_delay and motion is not None:
            action = np.zeros(len(ACTION.dims), dtype=np.float32)
            action[Y_DIMENSION], action[GRIPPER_DIMENSION] = motion
        elif self._is_frozen and step < self._response_step:
            return self.hold_action(slot)
        return np.clip(action, -1, 1).astype(np.float32)

    def hold_action(self, slot: int) -> FloatArray:
        """Return the action that moves neither point nor gripper."""
        action = np.zeros(len(ACTION.dims), dtype=np.float32)
        action[-1] = self._episodes[slot].gripper_width_m / GRIPPER_MAX_M * 2 - 1
        return action

    def cue_boxes(self, slot: int) -> CueBoxes:
        """Return the first rows of each image; see `CueLocator`."""
        return {name: (PixelBox(0, CUE_ROWS, 0, self._image_size_px),) for name in CAMERA_NAMES}

    def close(self) -> None:
        """Forget all episodes."""
        self._episodes = {}

    def _new_episode(self, seed: int) -> _Episode:
        rng = np.random.default_rng([seed, self._n_items])
        places = rng.permutation(self._n_items) - (self._n_items - 1) / 2
        candidates = np.column_stack(
            [np.zeros(self._n_items), places * CANDIDATE_SPACING_M, np.full(self._n_items, CANDIDATE_Z_M)]
        )
        return _Episode(
            seed=seed,
            candidates_m=candidates,
            targets=self._draw_targets(rng),
            ball_m=np.array([rng.uniform(-0.1, 0.1), -0.6, CANDIDATE_Z_M]),
            ball_velocity_m_s=np.array([0.0, self._swapped_m_s(rng.uniform(*self._speeds_m_s)), 0.0]),
            goal_m=np.array([rng.uniform(0.15, 0.2), 0.3, 0.0]),
        )

    def _draw_targets(self, rng: np.random.Generator) -> tuple[int, ...]:
        if self._n_items and self._n_shown == 1:
            return ((int(rng.integers(self._n_items)) + self._swap_cue) % self._n_items,)
        drawn = rng.permutation(self._n_items)
        shown = [int(i) for i in drawn[: self._n_shown]]
        if shown and self._swap_cue:
            shown[0] = int(drawn[self._n_shown + self._swap_cue - 1])
        if self._swap_order:
            shown[0], shown[self._swap_order] = shown[self._swap_order], shown[0]
        return tuple(shown)

    def _swapped_m_s(self, drawn_m_s: float) -> float:
        least, most = self._speeds_m_s
        half = (most - least) / 2 if self._swap_cue else 0.0
        return drawn_m_s + half if drawn_m_s < least + half else drawn_m_s - half

    def _advance(self, episode: _Episode, action: Vector) -> None:
        moved = action[:3] * M_PER_STEP
        episode.step += 1
        episode.tcp_m = episode.tcp_m + moved
        episode.tcp_velocity_m_s = moved * CONTROL_HZ
        episode.gripper_width_m = float((action[-1] + 1) / 2 * GRIPPER_MAX_M)
        episode.is_static = bool(np.all(np.abs(action[:3]) < STATIC_ACTION))
        # The arm comes from above: a ball that rolls under a lifted point is not caught.
        if not episode.targets and np.linalg.norm(episode.ball_m - episode.tcp_m) <= REACH_M:
            episode.ball_velocity_m_s = episode.tcp_velocity_m_s * (1, 1, 0)
        episode.ball_m = episode.ball_m + episode.ball_velocity_m_s / CONTROL_HZ
        touched = self._touched(episode)
        if touched is not None and touched not in episode.touched:
            episode.touched.append(touched)

    def _touched(self, episode: _Episode) -> int | None:
        """Return the candidate that is being touched, if any: near, at rest, in the response phase."""
        if episode.step < self._response_step or not episode.is_static or not self._n_items:
            return None
        distances = np.linalg.norm(episode.candidates_m - episode.tcp_m, axis=1)
        nearest = int(np.argmin(distances))
        return nearest if distances[nearest] <= self._touch_reach_m else None

    def _is_complete(self, episode: _Episode) -> bool:
        """Whether all right candidates have been touched; if there are several, no other may be."""
        if len(episode.targets) == 1:
            return True
        touched = tuple(episode.touched)
        return touched == episode.targets if self._in_order else set(touched) == set(episode.targets)

    def _phase(self, episode: _Episode) -> Phase:
        if episode.step >= self._response_step:
            return "response"
        return "cue" if episode.step < self._cue_steps else "delay"

    def _is_in_view(self, episode: _Episode) -> bool:
        return self._shows_cue and self._cue_after_steps <= episode.step < self._cue_steps

    def _result(self, slot: int, *, render: bool) -> StepResult:
        episode = self._episodes[slot]
        if not episode.targets:
            success = bool(np.linalg.norm((episode.ball_m - episode.goal_m)[:2]) <= GOAL_RADIUS_M)
        else:
            success = self._touched(episode) in episode.targets and self._is_complete(episode)
        n_wrong = sum(choice not in episode.targets for choice in episode.touched)
        is_lost = self._is_strict and n_wrong > 0
        status = TaskStatus(
            phase=self._phase(episode),
            success=success and not is_lost,
            fail=is_lost,
            right_first_choices=episode.targets[:1] if self._in_order else episode.targets,
            chance_success=chance_of_several(self._n_items, self._n_shown, in_order=self._in_order)
            if self._n_items
            else None,
            candidate_places=places_from_right(episode.candidates_m[:, :2]),
            right_candidates=episode.targets,
            touched_candidates=tuple(episode.touched),
            n_candidates=self._n_items,
            n_wrong_choices=n_wrong,
        )
        return StepResult(
            observation=self._observe(episode, render=render), status=status, reward=float(status.success)
        )

    def _observe(self, episode: _Episode, *, render: bool) -> Observation:
        fingers = [episode.gripper_width_m / 2] * 2
        state = {
            "tcp_pose": [*episode.tcp_m, 0, 1, 0, 0],
            "qpos": [*episode.tcp_m, 0, 0, 0, 0, *fingers],
            "qvel": [*episode.tcp_velocity_m_s, 0, 0, 0, 0, 0, 0],
        }
        render = render and bool(self._settings.cameras)
        self.n_renders += render
        return Observation(
            step=episode.step,
            images={name: self._image(episode, name) for name in self._shown(episode)} if render else {},
            state={name: np.array(values, dtype=np.float32) for name, values in state.items()},
            privileged=self._privileged(episode) if self._settings.privileged else None,
        )

    def _shown(self, episode: _Episode) -> tuple[str, ...]:
        shows_human = self._settings.shows_human_camera(episode.step, self.spec.horizon_steps)
        return (*self._settings.cameras, *([HUMAN_CAMERA] if shows_human else []))

    def _image(self, episode: _Episode, camera: str) -> ImageArray:
        """Return an image that shows the cue in its first rows and otherwise depends only on the state."""
        view = [*CAMERA_NAMES, HUMAN_CAMERA].index(camera)
        rng = np.random.default_rng(
            [episode.seed, episode.step, view, *np.abs(episode.tcp_m * 1e6).astype(int)]
        )
        image = rng.integers(0, 256, (self._image_size_px, self._image_size_px, 3), dtype=np.uint8)
        in_view = self._is_in_view(episode) and episode.targets
        shown = episode.targets[1 if self._shuffles_cue else 0] if in_view else 0
        image[:CUE_ROWS] = 20 * (shown + 1) if in_view else 0
        first = self._cue_steps + (self._response_step - self._cue_steps - self._distract_steps) // 2
        if first <= episode.step < first + self._distract_steps:
            image[:CUE_ROWS] = DISTRACTOR_LEVEL
        return image

    def _privileged(self, episode: _Episode) -> PrivilegedState:
        bodies = {}
        if not episode.targets:
            bodies["ball"] = BodyState(
                position_m=episode.ball_m.copy(), velocity_m_s=episode.ball_velocity_m_s.copy()
            )
            bodies["goal"] = BodyState(position_m=episode.goal_m.copy(), velocity_m_s=np.zeros(3))
        return PrivilegedState(
            phase=self._phase(episode),
            response_step=self._response_step,
            tcp_position_m=episode.tcp_m.copy(),
            tcp_velocity_m_s=episode.tcp_velocity_m_s.copy(),
            gripper_width_m=episode.gripper_width_m,
            candidate_positions_m=episode.candidates_m.copy(),
            right_candidates=episode.targets,
            shown_candidates=episode.targets if self._is_in_view(episode) else (),
            in_order=self._in_order,
            touched_candidates=tuple(episode.touched),
            bodies=bodies,
        )


def _defaults(task: TaskSpec) -> Mapping[str, Any]:  # Any: numbers and pairs of them
    if not task.has_candidates:
        return BALL_DEFAULTS
    return {**(SEVERAL_DEFAULTS if task.several_right else CHOICE_DEFAULTS), **task.candidate_counts}
