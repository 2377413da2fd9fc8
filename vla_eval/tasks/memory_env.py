"""The base of all memory tasks: robot, cameras, table, phases, placing and parking of objects.

`docs/tasks.md` says what differs from the official code in every task, and why. Hidden objects are parked on
the floor, at rest, beyond the far plane of every camera.

What a task knows of its episodes is numpy, (B, …) for B parallel environments: for one arm, torch takes most
of a control step. Tensors are made only for those who step ManiSkill's environment itself (`get_info`).
"""

import functools
import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import sapien
import torch
from mani_skill.render.utils import can_render
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs import Actor, Pose

from vla_eval.core import FloatArray
from vla_eval.errors import TaskArgumentError
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots.arm import Arm
from vla_eval.robots.find import robot_with_uid
from vla_eval.seeding import Stream, generator
from vla_eval.task_state import PHASES, PrivilegedState, TaskStatus
from vla_eval.tasks.arm.robots import ParsedArms, kept_loader
from vla_eval.tasks.interface import BASE_CAMERA_M, CAMERA_FOV_RAD, StepRange, step_range
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Body, Flags, Indices, Steps, anywhere, place, velocity_of
from vla_eval.tasks.objects.clutter import Clutter
from vla_eval.tasks.objects.free_places import Area, free_places_m
from vla_eval.tasks.objects.item_names import THING_NAMES
from vla_eval.tasks.objects.layout import Plane
from vla_eval.tasks.objects.limits import ClutterCount, ImageSize, NotNegative, Positive
from vla_eval.tasks.tensors_out import Info, TensorsOut

QPOS_NOISE_RAD = 0.02
FLOOR_Z_M = -0.9196429  # the height of ManiSkill's table
PARK_X_M = 150.0  # every camera's far plane is at 100 m
PARK_SPACING_M = 0.3
_look_at = functools.cache(sapien_utils.look_at)  # each reset asks for the same
CPU_BACKENDS = ("auto", "cpu", "physx_cpu")  # "auto" is the CPU for a single environment


Place = tuple[float, float, float]
"""x, y, z in m, world frame."""
Wxyz = tuple[float, float, float, float]
"""A rotation."""


class CueSize(NamedTuple):
    """A box upright on the table that holds a shown object whose place is in the middle of its base."""

    half_width_m: float
    height_m: float


class MemoryTableEnv(TensorsOut):
    """A Panda with a wrist camera at a table, with the phases cue, delay and response.

    Action space: ManiSkill's, by `control_mode`; the harness uses `pd_ee_delta_pose`.

    Observation space: ManiSkill's `rgb` (`agent/qpos`, `agent/qvel`, `extra/tcp_pose`, two cameras) or
    `state` (the same without cameras, and what the task adds).

    Args:
        cue_steps: control steps during which the cue is shown; a pair is a range to draw from per episode.
        delay_steps: control steps between the cue and the choice; also takes a pair.
        swap_cue: 0 to `n_swaps()`; which other cue is shown instead of the drawn one. It has its own right
            answer. Whatever else is drawn for the seed stays the same: places, noise, durations.
        freeze_until_choice: hold arm and gripper width until the response phase, whatever the action.
        move_in_delay: a scripted motion moves arm and gripper during the delay, whatever the action.
        phase_gate_success: success counts only in the response phase (the official code has no gate).
        static_threshold_rad_s: the arm is at rest if no joint moves faster.
        instruction: the sentence for `info["language_instruction"]`; `gymnasium.make` gives the paper's.
        reconfiguration_freq: number of resets after which the scene is rebuilt. None: at every reset on
            the CPU simulator (20 ms), never on the GPU simulator. In a reused scene PhysX keeps contact
            caches, so states differ from those of a new scene (measured: from 1e-7 to 15 rad/s after
            contact).
        control_mode: what an action means, see `control_modes`. None: ManiSkill's default for the arm.
        image_size: height and width of the images of both cameras, pixels.
        clutter: how many everyday things are fixed around what the task uses: touching one is no choice.
            All else begins the same for the same seed, and so do the first ones if there are more.
        robot_uids: `panda_wristcam`; `panda_wristcam_seen`, which gives the same images faster;
            `panda_wristcam_light` with a simplified camera mesh; or that of another robot.
    """

    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")
    FAMILY: int
    """Number of the task family in random streams. Part of every result: never renumber, only add."""
    distract_steps = 0
    """In so many steps of the delay something else is shown, in tasks that take this as an argument."""
    HUMAN_CAMERA_EYE: tuple[float, float, float] = (0.5, 1.0, 1.0)
    HUMAN_CAMERA_TARGET: tuple[float, float, float] = (-0.3, 0.0, 0.0)

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "panda_wristcam",
        control_mode: str | None = None,
        image_size: ImageSize = IMAGE_SIZE_PX,
        clutter: ClutterCount = 0,
        cue_steps: StepRange = 5,
        delay_steps: StepRange = 5,
        swap_cue: NotNegative = 0,
        freeze_until_choice: bool = False,
        move_in_delay: bool = False,
        phase_gate_success: bool = True,
        static_threshold_rad_s: Positive = 0.2,
        instruction: str | None = None,
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        self.cue_steps_range = step_range("cue_steps", cue_steps)
        self.delay_steps_range = step_range("delay_steps", delay_steps)
        limits.check(NotNegative, swap_cue=swap_cue)
        limits.check_together(
            swap_cue=swap_cue,
            n_swaps=self.n_swaps(),
            distract_steps=self.distract_steps,
            least_delay=self.delay_steps_range[0],
        )
        self.swap_cue = swap_cue
        self.freeze_until_choice = freeze_until_choice
        self.move_in_delay = move_in_delay
        self.phase_gate_success = phase_gate_success
        self.static_threshold_rad_s = static_threshold_rad_s
        self.instruction = instruction
        self.arm: Arm = robot_with_uid(robot_uids, where=f"robot_uids of {type(self).__name__}")
        importlib.import_module(self.arm.agent.partition(":")[0])  # registers it with ManiSkill
        limits.check(Positive, static_threshold_rad_s=static_threshold_rad_s)
        limits.check(ClutterCount, clutter=clutter)
        self.clutter = clutter
        self._clutter_places_m = self._free_places_m() if clutter else np.zeros((0, 2))
        self._parsed_arms: ParsedArms = {}
        # Without it an unseeded reset would repeat the last episode: ManiSkill then keeps the old seed.
        kwargs.setdefault("enhanced_determinism", True)
        if reconfiguration_freq is None:
            on_cpu = kwargs.get("sim_backend", "auto") in CPU_BACKENDS and kwargs.get("num_envs", 1) == 1
            reconfiguration_freq = 1 if on_cpu else 0
        limits.check(ImageSize, image_size=image_size)
        if image_size != IMAGE_SIZE_PX:
            size = {"width": image_size, "height": image_size}
            kwargs["sensor_configs"] = {**kwargs.get("sensor_configs", {}), **size}
        super().__init__(
            *args,
            robot_uids=robot_uids,
            control_mode=control_mode,
            reconfiguration_freq=reconfiguration_freq,
            **kwargs,
        )
        limits.check_together(move_in_delay=move_in_delay, control_mode=self.control_mode)

    def n_swaps(self) -> int:
        """Return how many other cues the same scene could have; `swap_cue` selects one of them."""
        raise NotImplementedError

    def _free_places_m(self) -> Plane:
        places_m = free_places_m(self.used_areas(), base_m=self.arm.base_m)
        n_free = {"n_free_things": len(self.free_things()), "n_free_places": len(places_m)}
        limits.check_together(clutter=self.clutter, **n_free)
        return places_m

    def used_areas(self) -> tuple[Area, ...]:
        """Return the areas of the table that objects and hand can use in any episode of this task."""
        raise TaskArgumentError(
            f"clutter: {type(self).__name__} has no method `used_areas`. Define it, or leave clutter out."
        )

    def free_things(self) -> tuple[str, ...]:
        """Return the names of the everyday things that are no candidates of this task."""
        return THING_NAMES

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = _look_at(*BASE_CAMERA_M)
        return [CameraConfig("base_camera", pose, IMAGE_SIZE_PX, IMAGE_SIZE_PX, CAMERA_FOV_RAD, 0.01, 100)]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = _look_at(self.HUMAN_CAMERA_EYE, self.HUMAN_CAMERA_TARGET)
        return CameraConfig("render_camera", pose, 512, 512, 1.0, 0.01, 100)

    def _reconfigure(self, options: dict[str, Any]) -> None:
        # Shapes have materials even if nothing is rendered. SAPIEN starts its renderer for the first material
        # and stops it with the last one: without this one, once for every shape. A task must not keep it
        # longer: there is one renderer per process, and the first to render chooses its device. Environments
        # keep one, see `envs.scenes`.
        kept = None if can_render(self._render_device) else sapien.render.RenderMaterial()
        super()._reconfigure(options)
        del kept

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        self.scene.create_urdf_loader = functools.partial(kept_loader, self.scene, self._parsed_arms)
        super()._load_agent(options, self._base_pose())

    def _base_pose(self) -> sapien.Pose:
        half_rad = self.arm.base_yaw_rad / 2
        return sapien.Pose(self.arm.base_m, [math.cos(half_rad), 0, 0, math.sin(half_rad)])

    def close(self) -> None:
        """Release the simulator, and with it the renderer: what is kept of the arm has materials."""
        self._parsed_arms.clear()
        super().close()

    def _load_scene(self, options: dict[str, Any]) -> None:
        self.table_scene = TableSceneBuilder(env=self, robot_init_qpos_noise=QPOS_NOISE_RAD)
        self.table_scene.build()
        self._park_index: dict[str, int] = {}
        self._response_step: Steps = np.zeros(self.num_envs, dtype=np.int32)
        self._cue_end_step = np.zeros_like(self._response_step)
        self._load_items()
        things = self.free_things()[: self.clutter]
        self._clutter = Clutter(self.scene, things, self._clutter_places_m, parked=self.parking_pose)

    def _load_items(self) -> None:
        """Build the objects of the task, each at `parking_pose(...)`."""
        raise NotImplementedError

    def parking_pose(self, name: str, *, half_height_m: float) -> sapien.Pose:
        """Return the position of a hidden object of this name, world frame."""
        index = self._park_index.setdefault(name, len(self._park_index))
        return sapien.Pose(p=[PARK_X_M + PARK_SPACING_M * index, 0, FLOOR_Z_M + half_height_m])

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        arm = self.arm
        qpos = np.tile(np.array(arm.rest_qpos), (len(env_idx), 1))
        for row, env in enumerate(env_idx.tolist()):
            noise = self.episode_generator(env, Stream.ROBOT).normal(0, QPOS_NOISE_RAD, len(arm.arm_joints))
            qpos[row, arm.arm_joints] += noise
            phases = self.episode_generator(env, Stream.PHASES)
            cue_steps = int(phases.integers(*self.cue_steps_range, endpoint=True))
            self._cue_end_step[env] = self.total_cue_steps(cue_steps)
            delay = int(phases.integers(*self.delay_steps_range, endpoint=True))
            self._response_step[env] = self._cue_end_step[env] + delay
        self.agent.reset(qpos.astype(np.float32))
        self.agent.robot.set_pose(self._base_pose())
        for env in env_idx.tolist():
            self._sample_episode(env)
        mask = np.zeros(self.num_envs, dtype=np.bool_)
        mask[env_idx.cpu().numpy()] = True
        clutter_rng = functools.partial(self.episode_generator, stream=Stream.CLUTTER)
        for actor, standing in self._clutter.drawn(mask, clutter_rng):
            self.move(actor, mask, standing)
        self._on_episode_start(mask)
        self._on_phase_edges(np.zeros_like(self._response_step), mask)

    def _sample_episode(self, env: int) -> None:
        """Draw all random values of one episode, from `episode_generator` alone."""
        raise NotImplementedError

    def _on_episode_start(self, mask: Flags) -> None:
        """Place all objects as before the first phase, and reset the latches, where `mask` holds."""
        raise NotImplementedError

    def episode_generator(self, env: int, stream: Stream) -> np.random.Generator:
        """Return the generator of one purpose of the episode that runs in parallel environment `env`."""
        return generator(int(self._episode_seed[env]), stream, *self.stream_key())

    def stream_key(self) -> tuple[int, ...]:
        """Return numbers that separate this task's random draws from those of other tasks.

        Without them the same seed would give the same answer in every task with as many candidates, and
        the successes of a blind arm would be correlated between tasks.
        """
        return (self.FAMILY,)

    def total_cue_steps(self, cue_steps: int) -> int:
        """Return the length of the cue phase; it is longer if a task shows several objects in turn."""
        return cue_steps

    def longest_wait_steps(self) -> int:
        """Return the most steps that cue and delay can take together."""
        return self.total_cue_steps(self.cue_steps_range[1]) + self.delay_steps_range[1]

    def phase_index(self, step: Steps) -> Indices:
        """Return (B,) indices into `PHASES` for observations after `step` control steps."""
        return (step >= self._cue_end_step).astype(np.int64) + (step >= self._response_step)

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        """Hide and reveal objects where a phase begins at `step`; return whether any was moved."""
        raise NotImplementedError

    def _update_latches(self, step: Steps) -> None:
        """Record what happened in this control step and is needed later."""

    def _after_control_step(self) -> None:
        if self.gpu_sim_enabled:
            self.scene._gpu_fetch_all()
        step = self.step_count() + 1  # ManiSkill counts only after this hook
        moved = self._on_phase_edges(step, step > 0)  # in all environments
        if moved and self.gpu_sim_enabled:
            self.scene._gpu_apply_all()
            self.scene._gpu_fetch_all()
        self._update_latches(step)

    @contextmanager
    def _only(self, mask: Flags) -> Iterator[None]:
        """Let setters of actors write only where `mask` holds: ManiSkill writes by `scene._reset_mask`."""
        previous = self.scene._reset_mask
        self.scene._reset_mask = torch.as_tensor(mask, device=self.device)
        try:
            yield
        finally:
            self.scene._reset_mask = previous

    def move(self, actor: Actor, mask: Flags, poses: FloatArray | sapien.Pose) -> None:
        """Move an actor, at rest, to a pose in the environments of the mask (B,).

        `poses`, world frame, are (B, 7) positions and rotations (wxyz), of which the rows of the mask are
        used, or one for all.
        """
        if not anywhere(mask):
            return
        if not self.gpu_sim_enabled:  # one environment, its actor without a tensor
            place(actor, poses if isinstance(poses, sapien.Pose) else sapien.Pose(poses[0, :3], poses[0, 3:]))
            return
        with self._only(mask):
            one = isinstance(poses, sapien.Pose)
            actor.set_pose(poses if one else Pose.create(torch.as_tensor(poses[mask], device=self.device)))
            if actor.px_body_type == "dynamic":
                for set_velocity in (actor.set_linear_velocity, actor.set_angular_velocity):
                    set_velocity(torch.zeros(3, device=self.device))

    def response_begun(self) -> Flags:
        """Return (B,) bool: the response phase has begun."""
        return self.step_count() >= self._response_step

    def gated(self, success: Flags) -> Flags:
        """Return success where it counts: in the response phase, or always without the gate."""
        if not self.phase_gate_success:
            return success
        return success & self.response_begun()

    def moving_bodies(self) -> dict[str, Body]:
        """Return name -> body of the objects that an expert may see in addition to candidates."""
        return {}

    def wording(self, env: int) -> dict[str, str]:
        """Return what stands for the words in braces of the instruction in one environment's episode."""
        return {}

    def cue_places_m(self, env: int) -> list[Place]:
        """Return where objects are shown as the cue of one environment's episode, each on the table."""
        raise NotImplementedError

    def cue_size_m(self) -> CueSize:
        """Return a size that no object that is shown exceeds."""
        raise NotImplementedError

    def status(self, info: Info, env: int) -> TaskStatus:
        """Return the status of one environment's episode; `info` is `read_info()` of the present step."""
        return TaskStatus(phase=PHASES[int(info["phase"][env])], success=bool(info["success"][env]))

    def true_state(self, info: Info, env: int) -> PrivilegedState:
        """Return what scripted controls see of one environment's episode; `info` as for `status`."""
        return PrivilegedState(
            phase=PHASES[int(info["phase"][env])],
            response_step=int(self._response_step[env]),
            tcp_position_m=self.tcp_position_m()[env].astype(np.float64),
            tcp_velocity_m_s=velocity_of(self.agent.tcp)[env].astype(np.float64),
            gripper_width_m=float(self.gripper_width_m()[env]),
            candidate_positions_m=np.zeros((0, 3)),
            bodies={name: body.state(env) for name, body in self.moving_bodies().items()},
            tcp_yaw_rad=float(self.tcp_yaw_rad()[env]),
        )

    def evaluate(self) -> Info:
        """Read success, failure and what they depend on; changes nothing."""
        raise NotImplementedError

    def read_info(self) -> Info:
        """Return the info of the present step, (B, …) arrays by name; every array in it is a new one."""
        steps = self.step_count()
        return {"elapsed_steps": steps.copy(), **self.evaluate(), "phase": self.phase_index(steps)}

    def normalized_reward(self, info: Info) -> FloatArray:
        """Return the (B,) dense reward of the present step, divided by its value at success."""
        return self.dense_reward(self.reward_terms(info), info) / np.float32(self.MAX_REWARD)


def poses(positions_m: FloatArray, wxyz: FloatArray | Wxyz = (1.0, 0.0, 0.0, 0.0)) -> FloatArray:
    """Return (B, 7) poses of (B, 3) positions, with one rotation for all or (B, 4)."""
    turned = np.broadcast_to(np.asarray(wxyz, dtype=np.float32), (len(positions_m), 4))
    return np.concatenate((positions_m, turned), axis=1)


def nearness(scale_per_m: float, distance_m: FloatArray) -> FloatArray:
    """Return `1 - tanh(scale * distance)`, the official code's shaping: 1 at no distance, 0 far away."""
    near: FloatArray = 1 - np.tanh(scale_per_m * distance_m)
    return near
