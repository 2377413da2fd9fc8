"""The ManiSkill adapter: torch ends here, numpy begins. Knows nothing of policies or records.

On the CPU simulator every slot is a separate environment. On the GPU simulator all slots are one
vectorised environment, in which slots without an action hold still. ManiSkill itself runs with
`obs_mode="none"`: images are rendered only on request.
"""

import gc
import itertools
import math
from collections.abc import Mapping
from typing import Any  # ManiSkill is untyped: its environments and infos are Any here

import vla_eval.envs.lean_import  # noqa: F401  first: the others import ManiSkill

# isort: split
import numpy as np
import torch

from vla_eval.config.environment import HUMAN_CAMERA, EnvSettings
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.core import FloatArray, ImageArray, Observation, StepResult
from vla_eval.cue_view import CueBoxes, PixelBox
from vla_eval.envs.scenes import build, describe, own_views, take_human_image, take_images
from vla_eval.errors import check_names
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots.find import ROBOT, ROBOT_UIDS, action_of, control_mode_of
from vla_eval.specs import EnvSpec
from vla_eval.tasks.appearance import with_appearance
from vla_eval.tasks.arguments import check_arguments, horizon_steps, robot_uid
from vla_eval.tasks.arm.arm_control import drive_together
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import CAMERA_NAMES, CONTROL_HZ, IMAGE_SIZE, cameras, states
from vla_eval.tasks.memory_env import CueSize, MemoryTableEnv, Place
from vla_eval.tasks.register import env_class

# ManiSkill collects garbage whenever it rebuilds a scene, which our tasks do at each reset. With all objects
# of the imported modules this takes 150 ms; once frozen, they cost nothing.
gc.freeze()


class ManiSkillEnv:
    """`SimEnv` on ManiSkill; see the module docstring."""

    def __init__(self, settings: EnvSettings) -> None:
        row = task_spec(settings.task)
        check_arguments(row, settings.kwargs)
        kwargs = {**row.kwargs, **settings.kwargs}
        wanted_steps = kwargs.pop("horizon_steps", None)
        check_names("camera", settings.cameras, CAMERA_NAMES, where=row.id)
        action = action_of(kwargs)
        self._settings = settings
        self._seeds = np.zeros(settings.n_slots, dtype=np.int64)
        batched = settings.sim_backend == "gpu"
        n_envs, self._slots_per_env = (1, settings.n_slots) if batched else (settings.n_slots, 1)
        self._envs: list[Any] = [
            _build(env_class(row), settings, kwargs, self._slots_per_env) for _ in range(n_envs)
        ]
        self.spec = EnvSpec(
            task=row.id,
            cameras=cameras(kwargs.get(IMAGE_SIZE, IMAGE_SIZE_PX)),
            states=states(self._envs[0].arm.joints, env_class(row).PROMPT_DIMS),
            action=action,
            horizon_steps=horizon_steps(row, self._envs[0].longest_wait_steps(), wanted_steps),
            control_hz=CONTROL_HZ,
            robot=self._envs[0].arm.name,
        )
        self.device = describe(self._envs[0], settings)
        self._views = own_views(settings, n_envs)

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the given slots; see `SimEnv.reset`."""
        results: dict[int, StepResult] = {}
        for index, slots in self._by_env(seeds):
            first = index * self._slots_per_env
            for slot in slots:
                self._seeds[slot] = seeds[slot]
            block = self._seeds[first : first + self._slots_per_env].tolist()
            env_idx = torch.tensor([slot - first for slot in slots], device=self._envs[index].device)
            self._envs[index].reset(seed=block, options={"env_idx": env_idx})
            results |= self._results(index, slots, frozenset(slots) if render else frozenset(), is_reset=True)
        return results

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one control step in each of the given slots; see `SimEnv.step`."""
        stepped = self._by_env(actions)
        n = self._slots_per_env
        slots_of_rows = (slot for index, _ in stepped for slot in range(index * n, (index + 1) * n))
        rows = [actions[slot] if slot in actions else self.hold_action(slot) for slot in slots_of_rows]
        if rows:
            drive_together([self._envs[index] for index, _ in stepped], np.array(rows))
        for index, _ in stepped:
            self._envs[index].simulate()
        results: dict[int, StepResult] = {}
        for index, slots in stepped:
            self._envs[index].finish()
            results |= self._results(index, slots, render)
        return results

    def hold_action(self, slot: int) -> FloatArray:
        """Return the (A,) action that moves nothing; see `SimEnv.hold_action`."""
        index, row = divmod(slot, self._slots_per_env)
        action: FloatArray = self._envs[index].hold_action()[row]
        return action

    def joint_targets(self, slot: int) -> FloatArray:
        """Return the (J,) joint positions, rad, at which the arm's controller aims since the last action."""
        index, row = divmod(slot, self._slots_per_env)
        targets: FloatArray = self._envs[index].joint_targets()[row]
        return targets

    def cue_boxes(self, slot: int) -> CueBoxes:
        """Return where in the images the cue is; see `CueLocator`."""
        index, row = divmod(slot, self._slots_per_env)
        return boxes_of_cue(self._envs[index], row, self._settings.cameras)

    def close(self) -> None:
        """Release the simulator."""
        for env in self._envs:
            env.close()
        self._envs, self._views = [], []

    def _by_env(self, slots: Mapping[int, object]) -> list[tuple[int, list[int]]]:
        """Return (environment index, its requested slots), in order."""
        grouped: dict[int, list[int]] = {}
        for slot in sorted(slots):
            grouped.setdefault(slot // self._slots_per_env, []).append(slot)
        return sorted(grouped.items())

    def _results(
        self, index: int, slots: list[int], render: frozenset[int], *, is_reset: bool = False
    ) -> dict[int, StepResult]:
        env = self._envs[index]
        info = env.read_info()
        steps = [int(info["elapsed_steps"][slot % self._slots_per_env]) for slot in slots]
        images = self._images(index, steps) if render.intersection(slots) else {}
        state = {"tcp_pose": env.tcp_pose(), "qpos": env.qpos(), "qvel": env.qvel()}
        if env.PROMPT_DIMS:
            state["task_cue"] = env.prompt()
        rewards = np.zeros(self._slots_per_env) if is_reset else env.normalized_reward(info)
        results = {}
        for slot in slots:
            row = slot % self._slots_per_env
            observation = Observation(
                step=int(info["elapsed_steps"][row]),
                images={name: batch[row].copy() for name, batch in images.items()} if slot in render else {},
                state={name: batch[row].copy() for name, batch in state.items()},
                privileged=env.true_state(info, row) if self._settings.privileged else None,
            )
            results[slot] = StepResult(
                observation=observation,
                status=env.status(info, row),
                reward=float(rewards[row]),
                executed_action=None if is_reset else env.executed_action[row].copy(),
                wording=env.wording(row) if is_reset else {},
            )
        return results

    def _images(self, index: int, steps: list[int]) -> dict[str, ImageArray]:
        env = self._envs[index]
        images = take_images(env, self._settings.cameras, self._views[index])
        if any(self._settings.shows_human_camera(step, self.spec.horizon_steps) for step in steps):
            images[HUMAN_CAMERA] = take_human_image(env)
        return images


def _build(cls: Any, settings: EnvSettings, kwargs: Mapping[str, Any], num_envs: int) -> Any:
    robot = robot_uid(kwargs, wrist_mesh=settings.render.wrist_mesh)
    others = {name: value for name, value in kwargs.items() if name != ROBOT}
    return build(
        with_appearance(cls, settings.appearance),
        settings,
        num_envs=num_envs,
        sim_backend="physx_cuda" if settings.sim_backend == "gpu" else "physx_cpu",
        **{**others, ROBOT_UIDS: robot, CONTROL_MODE: control_mode_of(kwargs)},
    )


MARGIN_PX = 1  # an edge's pixel may show some of the object
NEAR_M = 0.01  # what is nearer to the camera, or behind it, is not seen


def boxes_of_cue(env: MemoryTableEnv, row: int, cameras: tuple[str, ...]) -> CueBoxes:
    """Return the boxes that hold the cue of one parallel environment, in the images of these cameras."""
    places, size = env.cue_places_m(row), env.cue_size_m()
    found = {}
    for name in cameras:
        camera = env.scene.sensors[name].camera
        # (3, 4) world to camera in OpenCV's axes (z forward), and (3, 3) camera to pixels.
        extrinsic = camera.get_extrinsic_matrix()[row if env.gpu_sim_enabled else 0].cpu().numpy()
        intrinsic = camera.get_intrinsic_matrix()[row if env.gpu_sim_enabled else 0].cpu().numpy()
        edge_px = env.scene.sensors[name].config.width  # images are square
        boxes = (_box(place, size, intrinsic @ extrinsic, edge_px=edge_px) for place in places)
        found[name] = tuple(box for box in boxes if box is not None)
    return found


def _box(place: Place, size: CueSize, projection: np.ndarray[Any, Any], *, edge_px: int) -> PixelBox | None:
    """Return the box of the eight corners; None where nothing of it is in the image."""
    half, (x, y, z) = size.half_width_m, place
    corners = itertools.product((x - half, x + half), (y - half, y + half), (z, z + size.height_m))
    points = np.array([(*corner, 1.0) for corner in corners]) @ projection.T
    points = points[points[:, 2] > NEAR_M]
    if not len(points):
        return None
    columns, rows = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    top, bottom = _range(rows, edge_px)
    left, right = _range(columns, edge_px)
    return PixelBox(top, bottom, left, right) if top < bottom and left < right else None


def _range(values: np.ndarray[Any, Any], edge_px: int) -> tuple[int, int]:
    """Return the first pixel and the one after the last, within the image."""
    first, last = math.floor(values.min()) - MARGIN_PX, math.ceil(values.max()) + MARGIN_PX
    return min(max(first, 0), edge_px), min(max(last, 0), edge_px)
