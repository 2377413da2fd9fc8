"""Recipe, server and environment in one: what is sent and what comes back, or why they do not fit."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal  # Any: a request holds arrays and text

import numpy as np
from PIL import Image

from vla_eval.control_modes import EE_DELTA_POSE
from vla_eval.core import ImageArray, Observation
from vla_eval.errors import SimulationError, SpecMismatchError, did_you_mean, some_of
from vla_eval.policies.remote.actions import N_DELTA_POSE
from vla_eval.policies.remote.settings import CameraSettings, RemoteSettings
from vla_eval.policies.remote.state_layouts import StateLayout, layout_names, state_layout
from vla_eval.specs import EnvSpec
from vla_eval.wire.metadata import ServerMetadata
from vla_eval.wire.numbers import NumbersError, as_state

DEFAULT_PROMPT_KEY = "prompt"
MAX_HZ_DIFFERENCE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """How observations become requests."""

    cameras: Mapping[str, CameraSettings]  # camera of the environment -> how it is sent, with its size
    state: Mapping[str, StateLayout]  # key -> layout
    state_dims: Mapping[str, tuple[str, ...]]  # state of the environment -> names of its numbers
    prompt_key: str
    chunk_size: int
    reads: Literal["last", "every"]  # which frames the server must see

    @property
    def states(self) -> tuple[str, ...]:
        """The environment's states that are needed."""
        return tuple(dict.fromkeys(name for layout in self.state.values() for name in layout.states))

    def request(self, observation: Observation, instruction: str) -> dict[str, Any]:
        """Return what is sent of an observation; refuse a state that is not finite, or not a rotation."""
        for name in self.states:
            try:
                as_state(observation.state[name], self.state_dims[name])
            except NumbersError as exc:
                raise SimulationError(
                    f"step {observation.step}, state '{name}', which a policy server is sent: {exc}. The "
                    "simulation diverged, or the environment is not what its spec says."
                ) from exc
        fields: dict[str, Any] = {self.prompt_key: instruction}
        for name, camera in self.cameras.items():
            image = observation.images[name]
            if camera.resize is not None and camera.height_px is not None and camera.width_px is not None:
                image = resized(
                    image, height_px=camera.height_px, width_px=camera.width_px, how=camera.resize
                )
            fields[camera.key] = np.ascontiguousarray(image)
        for key, layout in self.state.items():
            fields[key] = layout.compute(observation.state)
        return fields


def fit(settings: RemoteSettings, server: ServerMetadata, env: EnvSpec, *, where: str) -> Fit:
    """Bring settings, server and environment together; refuse what does not fit, or is not said by any."""
    _check_actions(settings, server, env, where=where)
    chunk_size = _agreed("chunk_size", settings.chunk_size, server.chunk_size, where=where)
    if chunk_size is None:
        raise _unsaid("how many actions a reply has", "chunk_size", where=where)
    said = None if server.needs_every_frame is None else "every" if server.needs_every_frame else "last"
    reads = _agreed("reads", settings.reads, said, where=where) or "last"
    return Fit(
        cameras=_cameras(settings, server, env, where=where),
        state=_state(settings, server, env, where=where),
        state_dims={state.name: state.dims for state in env.states},
        prompt_key=settings.prompt_key or server.prompt_key or DEFAULT_PROMPT_KEY,
        chunk_size=chunk_size,
        reads="every" if reads == "every" else "last",
    )


def _agreed[T](name: str, in_recipe: T | None, at_server: T | None, *, where: str) -> T | None:
    if in_recipe is not None and at_server is not None and in_recipe != at_server:
        raise SpecMismatchError(
            f"{where}: {name} is {in_recipe} in the recipe, and the server says {at_server}. Correct the "
            f"recipe."
        )
    return at_server if in_recipe is None else in_recipe


def _unsaid(what: str, field: str, *, where: str) -> SpecMismatchError:
    return SpecMismatchError(
        f"{where}: the server does not say {what}. Write a recipe with `adapter: remote` and args.{field}; "
        f"policies/remote_openpi.yaml is an example."
    )


def _check_actions(settings: RemoteSettings, server: ServerMetadata, env: EnvSpec, *, where: str) -> None:
    action = env.action
    for what, there, here in (
        ("control mode", server.control_mode, action.control_mode),
        ("names of the actions", server.action_dims, action.dims),
    ):
        if there is not None and there != here:
            shown = [value if isinstance(value, str) else some_of(value) for value in (there, here)]
            raise SpecMismatchError(
                f"{where}: the {what} at the server: {shown[0]}; of {env.task}: {shown[1]}. Serve a policy "
                f"that was trained for these tasks."
            )
    if server.control_hz is not None and abs(server.control_hz - env.control_hz) > MAX_HZ_DIFFERENCE:
        raise SpecMismatchError(
            f"{where}: the server's policy acts at {server.control_hz:g} Hz, {env.task} at "
            f"{env.control_hz:g} Hz. Serve a policy that was trained for these tasks."
        )
    is_delta_pose = action.control_mode == EE_DELTA_POSE and len(action.dims) == N_DELTA_POSE
    if settings.actions is not None and not is_delta_pose:
        raise SpecMismatchError(
            f"{where}: `actions` in the recipe converts to {EE_DELTA_POSE} with {N_DELTA_POSE} numbers; "
            f"{env.task} has {action.control_mode} with {len(action.dims)}."
        )


def _cameras(
    settings: RemoteSettings, server: ServerMetadata, env: EnvSpec, *, where: str
) -> dict[str, CameraSettings]:
    wanted = settings.cameras
    if wanted is None and server.cameras is not None:
        wanted = {name: CameraSettings(key=image.key) for name, image in server.cameras.items()}
    if wanted is None:
        if server.is_ours:
            return {}  # a policy without cameras
        raise _unsaid("which images it wants", "cameras", where=where)
    sizes = {image.key: image for image in (server.cameras or {}).values()}
    missing = [key for key in sizes if key not in {camera.key for camera in wanted.values()}]
    if missing:
        raise SpecMismatchError(
            f"{where}: the server wants the images {some_of(sizes)}; the recipe sends no {some_of(missing)}. "
            f"Correct args.cameras in the recipe."
        )
    made: dict[str, CameraSettings] = {}
    for name, camera in wanted.items():
        said = sizes.get(camera.key)
        height = _agreed("height_px", camera.height_px, said and said.height_px, where=f"{where}, {name}")
        width = _agreed("width_px", camera.width_px, said and said.width_px, where=f"{where}, {name}")
        made[name] = CameraSettings(key=camera.key, height_px=height, width_px=width, resize=camera.resize)
        _check_size(made[name], name, env, where=where)
    return made


def _check_size(camera: CameraSettings, name: str, env: EnvSpec, *, where: str) -> None:
    """Raise unless the environment has the camera, and its images have the size or may be resized to it."""
    found = next((one for one in env.cameras if one.name == name), None)
    if found is None:
        names = [one.name for one in env.cameras]
        raise SpecMismatchError(
            f"{where}: there is no camera '{name}' in {env.task} (it has: {', '.join(names) or 'none'})."
            f"{did_you_mean(name, names)} Correct args.cameras in the recipe."
        )
    if camera.resize is not None:
        if camera.height_px is None or camera.width_px is None:
            raise _unsaid(
                f"the size of '{camera.key}'", f"cameras.{name}.height_px and width_px", where=where
            )
        return
    size, wanted = (found.height_px, found.width_px), (camera.height_px, camera.width_px)
    if any(one is not None and one != there for one, there in zip(wanted, size, strict=True)):
        raise SpecMismatchError(
            f"{where}: the server wants '{camera.key}' with {wanted[0]} × {wanted[1]} pixels, the images of "
            f"'{name}' in {env.task} have {size[0]} × {size[1]}. Set args.cameras.{name}.resize to pad or "
            f"plain in the recipe, as the policy was trained."
        )


def _state(
    settings: RemoteSettings, server: ServerMetadata, env: EnvSpec, *, where: str
) -> dict[str, StateLayout]:
    if settings.state is not None:
        return {key: state_layout(name, env, where=where) for key, name in settings.state.items()}
    if server.state_dims is None and not server.state_layouts:
        if server.is_ours:
            return {}  # a policy that reads none
        raise _unsaid("which state it wants", "state (`{}` for none)", where=where)
    if server.state_key is None:
        raise _unsaid("the key of the state", "state", where=where)
    layouts = server.state_layouts or {}
    name = next(iter(layouts), None)  # the first is its own
    if name is None:
        raise SpecMismatchError(
            f"{where}: the server wants a state of {len(server.state_dims or ())} numbers "
            f"({some_of(server.state_dims or ())}) and does not name its layout. Write a recipe with "
            f"args.state."
        )
    layout = state_layout(name, env, where=where)
    known = layout_names(name)
    if layout.n_numbers != len(layouts[name]) or known not in (None, layouts[name]):
        raise SpecMismatchError(
            f"{where}: the server's state layout '{name}' has {len(layouts[name])} numbers "
            f"({some_of(layouts[name])}), ours {layout.n_numbers} ({some_of(known or layout.states)}). Use "
            f"the same version of mikasa-vla-eval at both ends."
        )
    return {server.state_key: layout}


Resize = Literal["pad", "plain"]


def resized(image: ImageArray, *, height_px: int, width_px: int, how: Resize) -> ImageArray:
    """Return an image (H, W, 3) uint8 of another size, interpolated bilinearly; itself if it has that size.

    `pad` keeps the proportions and fills with black, the image in the middle; `plain` does not.

    Source of `pad` (the method): https://github.com/Physical-Intelligence/openpi/blob/15a9616a00943ada6c20a0f158e3adb39df2ccac/packages/openpi-client/src/openpi_client/image_tools.py
    """
    height, width = image.shape[:2]
    if (height, width) == (height_px, width_px):
        return image
    if how == "plain":
        return _scaled(image, height_px, width_px)
    ratio = max(width / width_px, height / height_px)
    inner_height, inner_width = max(1, int(height / ratio)), max(1, int(width / ratio))
    top, left = (height_px - inner_height) // 2, (width_px - inner_width) // 2
    padded = np.zeros((height_px, width_px, 3), dtype=np.uint8)
    inner = _scaled(image, inner_height, inner_width)
    padded[top : top + inner_height, left : left + inner_width] = inner
    return padded


def _scaled(image: ImageArray, height_px: int, width_px: int) -> ImageArray:
    scaled = Image.fromarray(image).resize((width_px, height_px), resample=Image.Resampling.BILINEAR)
    return np.asarray(scaled, dtype=np.uint8)
