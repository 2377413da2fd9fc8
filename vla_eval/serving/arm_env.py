"""The environment of a served policy that was trained on an arm's motors, by what its training noted."""

from vla_eval.checkpoints.files import TrainingFacts
from vla_eval.control_modes import MOTORS
from vla_eval.features import CAMERA_KEYS, CAMERA_PREFIX
from vla_eval.specs import ActionSpec, CameraSpec, EnvSpec, StateSpec
from vla_eval.tasks.real_stages import TWIN

UNLIMITED = 1e6  # the arm's own limits are the client's


def arm_env(facts: TrainingFacts, *, task: str) -> EnvSpec:
    """Return it, with an episode of one step."""
    dims = facts.action_names
    return EnvSpec(
        task=task,
        cameras=tuple(
            CameraSpec(name=_camera(field, facts), height_px=size[0], width_px=size[1], fov_rad=None)
            for field, size in facts.images.items()
        ),
        states=(StateSpec(name=MOTORS, dims=dims, unit="deg, gripper 0 to 100", frame="joint"),),
        action=ActionSpec(
            dims=dims,
            low=(-UNLIMITED,) * len(dims),
            high=(UNLIMITED,) * len(dims),
            control_mode=MOTORS,
            gripper_open=None,
        ),
        horizon_steps=1,
        control_hz=facts.fps,
    )


def _camera(field: str, facts: TrainingFacts) -> str:
    """Return the camera of a field: of the simulated arm by its table, else as LeRobot names it."""
    in_twin = any(task.startswith(TWIN) for task in facts.tasks)
    simulated = {key: camera for camera, key in CAMERA_KEYS.items()} if in_twin else {}
    return simulated.get(field, field.removeprefix(CAMERA_PREFIX))
