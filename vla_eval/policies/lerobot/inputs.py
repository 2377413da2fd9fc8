"""Which camera and proprioception go where, checked against what the policy saw in training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal  # lerobot is untyped

import numpy as np
import torch
from torch import Tensor

from vla_eval.checkpoints.files import TrainingFacts
from vla_eval.checkpoints.loading import LoadedPolicy
from vla_eval.checkpoints.trained_with import Asked, differences, refuse_differences
from vla_eval.control_modes import CONTROL_MODE, MOTORS
from vla_eval.core import Observation
from vla_eval.errors import SpecMismatchError, did_you_mean
from vla_eval.features import PROPRIO_STATES, STATE_KEY, StateKind, proprioception, state_names
from vla_eval.robots.arm import Arm
from vla_eval.robots.find import robot_of_spec
from vla_eval.robots.rows import PANDA
from vla_eval.specs import CameraSpec, EnvSpec

GivenState = StateKind | Literal["motors"]
"""Which numbers `observation.state` is: a kind of proprioception, or a robot's motors as LeRobot has them."""
MAX_UNIT = 1.0 + 1e-3  # statistics of images in [0, 1]; those of 0 … 255 are far beyond
MAX_FOV_DIFFERENCE_RAD = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class InputMap:
    """How an observation becomes what the preprocessor takes."""

    # camera of the environment -> field, as the dataset named it, in the policy's order
    cameras: Mapping[str, str]
    state: GivenState | None  # None for a policy without any
    arm: Arm = PANDA  # whose it is

    @property
    def states(self) -> tuple[str, ...]:
        """The states of the environment that it is computed from."""
        if self.state is None:
            return ()
        return (MOTORS,) if self.state == MOTORS else PROPRIO_STATES

    def tensors(self, observation: Observation) -> dict[str, Tensor]:
        """Return images (3, H, W) float32 in [0, 1] and state (D,) float32, by field."""
        fields = {
            key: torch.from_numpy(observation.images[camera].transpose(2, 0, 1).astype(np.float32) / 255)
            for camera, key in self.cameras.items()
        }
        if self.state is not None:
            given = observation.state.get(self.state)  # of a robot; or a client may have computed it
            if given is None and self.state != MOTORS:
                given = proprioception(observation.state, self.arm)[self.state]
            assert given is not None  # `state_kind` found it among those of the environment
            fields[STATE_KEY] = torch.from_numpy(given)
        return fields


@dataclass(frozen=True, slots=True, kw_only=True)
class InputOptions:
    """The recipe's fields about inputs."""

    cameras: Mapping[str, str]  # camera of the environment -> field of the dataset
    state: StateKind | None  # which proprioception; None: the one with that number of dimensions
    # fields of the policy that are left out on purpose; only for policies that mask them
    absent_cameras: Sequence[str]


def input_map(
    loaded_config: Any, preprocessor: Any, options: InputOptions, env: EnvSpec, *, policy: str
) -> InputMap:
    """Return how observations become inputs of a policy; refuse cameras, state or action that do not fit."""
    renamed = _of_steps(preprocessor, "rename_map")
    expected = _expected_cameras(loaded_config, options.absent_cameras, policy)
    by_field = {renamed.get(field, field): (camera, field) for camera, field in options.cameras.items()}
    sizes = {camera.name: (camera.height_px, camera.width_px) for camera in env.cameras}
    cameras: dict[str, str] = {}
    for field, shape in expected.items():
        if field not in by_field:
            raise SpecMismatchError(
                f"policy '{policy}' expects the image '{field}', found {', '.join(by_field) or 'none'}."
                f"{did_you_mean(field, by_field)} Map a camera of {env.task} ({', '.join(sizes)}) to it with "
                f"`cameras` in the recipe's args, or name it in `absent_cameras` if it was masked in "
                "training."
            )
        camera, raw_field = by_field[field]
        if camera not in sizes:
            raise SpecMismatchError(
                f"policy '{policy}': the recipe's `cameras` name '{camera}', which {env.task} does not "
                f"provide (it has: {', '.join(sizes)}).{did_you_mean(camera, sizes)}"
            )
        if shape[0] != 3:
            raise SpecMismatchError(
                f"policy '{policy}': the image '{field}' has the shape {shape}, expected (3, height, width)."
            )
        cameras[camera] = raw_field
    _check_action(loaded_config, env, policy)
    arm = robot_of_spec(env)
    kind = _state_kind(loaded_config, preprocessor, options.state, policy, env)
    return InputMap(cameras=cameras, state=kind, arm=arm)


def check_training(
    facts: TrainingFacts | None, inputs: InputMap, loaded: LoadedPolicy, env: EnvSpec, *, policy: str
) -> None:
    """Compare what the policy saw in training with what it will see; raise with all that differs."""
    sizes = {camera.name: (camera.height_px, camera.width_px) for camera in env.cameras}
    seen = {field: sizes[camera] for camera, field in inputs.cameras.items()}
    config, preprocessor = loaded.config, loaded.preprocessor
    problems = _range_problems(preprocessor) + _lens_problems(config, inputs, env) + _gripper_problems(loaded)
    if facts is None:
        shapes = {key: tuple(feature.shape[-2:]) for key, feature in config.image_features.items()}
        renamed = _of_steps(preprocessor, "rename_map")
        for field, size in seen.items():
            trained = shapes[renamed.get(field, field)]
            if trained != size and renamed.get(field, field) == field:
                problems.append(f"size of {field}: expected {trained}, found {size}. Set env.image_size.")
    problems += differences(facts, Asked(env, seen, inputs.state))
    refuse_differences(problems, policy=policy, task=env.task)


def _lens_problems(config: Any, inputs: InputMap, env: EnvSpec) -> list[str]:
    """Compare the field of view, for a policy that computes with it and says so by `camera_fov_rad`."""
    trained = getattr(config, "camera_fov_rad", None)
    if trained is None:
        return []
    return [
        f"field of view of {camera.name}: expected {trained:.4f} rad, found {_fov(camera)}"
        for camera in env.cameras
        if camera.name in inputs.cameras
        and (camera.fov_rad is None or abs(camera.fov_rad - trained) > MAX_FOV_DIFFERENCE_RAD)
    ]


def _fov(camera: CameraSpec) -> str:
    return "one that is not known" if camera.fov_rad is None else f"{camera.fov_rad:.4f} rad"


def _gripper_problems(loaded: LoadedPolicy) -> list[str]:
    """Compare how the gripper of training targets was encoded with how that of predictions is decoded."""
    grippers = [
        step.gripper
        for pipeline in (loaded.preprocessor, loaded.postprocessor)
        for step in pipeline.steps
        if hasattr(step, "gripper")
    ]
    return [
        f"gripper: expected {grippers[0]}, as before the policy, found {found} behind it. Fetch the complete "
        "checkpoint."
        for found in grippers
        if found != grippers[0]
    ]


def _range_problems(preprocessor: Any) -> list[str]:
    problems = []
    for key, statistics in _of_steps(preprocessor, "stats").items():
        if not key.startswith("observation.image"):
            continue
        highest = max(
            (float(np.max(statistics[name])) for name in ("max", "mean", "q99") if name in statistics),
            default=0.0,
        )
        if highest > MAX_UNIT:
            problems.append(
                f"range of {key}: expected statistics in [0, 1], found values up to {highest:.4g}"
            )
    return problems


def _expected_cameras(config: Any, absent: Sequence[str], policy: str) -> dict[str, tuple[int, ...]]:
    features = {key: tuple(feature.shape) for key, feature in config.image_features.items()}
    for field in absent:
        if field not in features:
            raise SpecMismatchError(
                f"policy '{policy}': `absent_cameras` names '{field}', which the policy does not expect "
                f"(it expects: {', '.join(features) or 'none'}).{did_you_mean(field, features)}"
            )
        if not hasattr(config, "empty_cameras"):
            raise SpecMismatchError(
                f"policy '{policy}' (type '{config.type}') does not mask missing cameras, so that "
                f"`absent_cameras` cannot leave out '{field}'. Map a camera to it."
            )
    # `empty_camera_i`: declared as masked by the policy's own configuration. Earlier frames have no camera.
    not_cameras = (*absent, *getattr(config, "memory_fields", ()))
    return {
        key: shape
        for key, shape in features.items()
        if key not in not_cameras and ".empty_camera_" not in key
    }


def _state_kind(
    config: Any, preprocessor: Any, wanted: StateKind | None, policy: str, env: EnvSpec
) -> GivenState | None:
    feature = config.robot_state_feature
    if feature is None:
        return None
    statistics = _of_steps(preprocessor, "stats").get(STATE_KEY, {})
    # Fine-tuned from a base, a configuration keeps the base's padded size; statistics are the dataset's.
    n_dims = next(
        (int(np.asarray(value).size) for name, value in statistics.items() if name != "count"), None
    )
    n_dims = int(feature.shape[0]) if n_dims is None else n_dims
    offered_states = {one.name: len(one.dims) for one in env.states}
    sizes: dict[GivenState, int] = {}
    if offered_states.keys() >= set(PROPRIO_STATES):
        sizes |= {kind: len(names) for kind, names in state_names(robot_of_spec(env)).items()}
    if MOTORS in offered_states:
        sizes[MOTORS] = offered_states[MOTORS]
    fitting = [kind for kind, size in sizes.items() if size == n_dims]
    if wanted is None and len(fitting) == 1:
        return fitting[0]
    if wanted is not None and sizes.get(wanted) == n_dims:
        return wanted
    offered = ", ".join(f"{kind} ({size})" for kind, size in sizes.items())
    raise SpecMismatchError(
        f"policy '{policy}' expects a state of {n_dims} dimensions, found "
        f"{f'{wanted} ({sizes.get(wanted)})' if wanted else 'none of that size'}. There is: {offered}."
    )


def _check_action(config: Any, env: EnvSpec, policy: str) -> None:
    feature = config.action_feature
    found = int(feature.shape[0]) if feature is not None else 0
    if found != len(env.action.dims):
        raise SpecMismatchError(
            f"policy '{policy}' gives actions of {found} dimensions; {env.task} expects "
            f"{len(env.action.dims)} ({', '.join(env.action.dims)}, {env.action.control_mode}). Fine-tune it "
            f"on demonstrations of this task, or set env.{CONTROL_MODE} to what it was trained for."
        )


def _of_steps(preprocessor: Any, name: str) -> dict[str, Any]:
    """Return the first such attribute of the steps that is not empty."""
    found = (getattr(step, name, None) for step in preprocessor.steps)
    return next((dict(one) for one in found if one), {})
