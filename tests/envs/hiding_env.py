"""A small environment that hides and places objects as official ones do: by poses that `evaluate` writes."""

from typing import Any

import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building import actors
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.structs.pose import Pose

HALF_M = 0.02
HIDDEN_M = 1000.0
PLACED_M = (0.5, 0.0, HALF_M)
HIDDEN_STEPS, PLACED_STEP = 6, 8


class HidingEnv(BaseEnv):  # type: ignore[misc]
    """A cube that is shown 1000 m up for the first steps; another that is placed elsewhere at one
    step; a third that is parked."""

    def __init__(self, **kwargs: Any) -> None:
        backends = {"sim_backend": "physx_cpu", "render_backend": "none"}
        super().__init__(num_envs=1, obs_mode="none", robot_uids="panda_wristcam", **backends, **kwargs)

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))

    def _load_scene(self, options: dict[str, Any]) -> None:
        build_ground(self.scene)
        cube = {"half_size": HALF_M, "color": [1, 0, 0, 1], "body_type": "dynamic"}
        self.hidden = actors.build_cube(
            self.scene, **cube, name="hidden", initial_pose=sapien.Pose([0, 0, HALF_M])
        )
        self.parked = actors.build_cube(
            self.scene, **cube, name="parked", initial_pose=sapien.Pose([0, 1, HIDDEN_M])
        )
        self.placed = actors.build_cube(
            self.scene, **cube, name="placed", initial_pose=sapien.Pose([1, 0, HALF_M])
        )

    def _initialize_episode(self, env_idx: Any, options: dict[str, Any]) -> None:
        self.n_evaluated = 0
        self.task_cue, self.oracle_info = None, torch.tensor([1])
        places_m = {
            self.hidden: (0.0, 0.0, HALF_M),
            self.placed: (1.0, 0.0, HALF_M),
            self.parked: (0.0, 1.0, HIDDEN_M),
        }
        for cube, place_m in places_m.items():
            cube.set_pose(Pose.create_from_pq(list(place_m)))
            cube.set_linear_velocity(torch.zeros(1, 3))
            cube.set_angular_velocity(torch.zeros(1, 3))

    def evaluate(self) -> dict[str, Any]:
        self.n_evaluated += 1
        step = int(self.elapsed_steps[0])
        if step < HIDDEN_STEPS:
            pose = self.hidden.pose.raw_pose.clone()
            pose[:, 2] = HIDDEN_M
            self.hidden.pose = pose
        if step == PLACED_STEP:
            self.placed.set_pose(Pose.create_from_pq(list(PLACED_M)))
            self.placed.set_linear_velocity(torch.zeros(1, 3))
        return {"success": torch.tensor([self.n_evaluated > 99]), "oracle_info": self.oracle_info}

    def compute_normalized_dense_reward(self, obs: Any, action: Any, info: Any) -> Any:
        info["success"] |= True  # as official rewards do: they write into what they are given
        return torch.zeros(1)
