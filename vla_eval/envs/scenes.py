"""What adapters of ManiSkill environments share: images, the renderer's name. Knows no tasks."""

import re
from collections.abc import Mapping
from typing import Any  # ManiSkill is untyped: its environments and tensors are Any here

import sapien
import torch

from vla_eval.config.environment import EnvSettings
from vla_eval.core import ImageArray
from vla_eval.envs.camera_view import CameraView
from vla_eval.envs.dense_bodies import DenseBodies
from vla_eval.envs.shaders import check_no_environment_map, use_lean_shaders
from vla_eval.errors import MissingDependencyError, RenderingError
from vla_eval.strict.devices import refuse_missing_gpu

RENDERING_ADVICE = (
    "Run `mikasa-vla doctor`; on a machine without GPU, SAPIEN needs Mesa's lavapipe ≥ 24.3, which "
    "`make setup` installs."
)


CPU_RENDERER = "sapien_cpu"
_MISSING_FILE = re.compile(r"filesystem error: .*No such file or directory \[(.+)\]")  # as SAPIEN says it


def render_backend(settings: EnvSettings) -> str:
    """Return the name ManiSkill uses; without cameras no renderer is started at all."""
    if not settings.cameras:
        return "none"
    if settings.render.backend == "auto":
        return "sapien_cuda" if torch.cuda.is_available() else CPU_RENDERER
    refuse_missing_gpu(torch.cuda.device_count(), {"render.backend": settings.render.backend})
    return {"cpu": CPU_RENDERER, "gpu": "sapien_cuda"}.get(settings.render.backend, settings.render.backend)


_kept: list[Any] = []  # SAPIEN has one renderer per process


def share_vulkan(backend: str) -> None:
    """Let environments without a renderer share one Vulkan instance; one with a renderer chooses its device.

    Scenes without a renderer have materials, too. The first one makes an instance, which ends with the last:
    one per reset, half of its time. NVIDIA's driver refuses another after some tens
    (`ErrorIncompatibleDriver`). The first to render chooses the device, so that the shared one must be gone.
    """
    if backend != "none":
        _kept.clear()
    elif not _kept:
        _kept.append(sapien.render.RenderMaterial())


def build(cls: Any, settings: EnvSettings, **arguments: Any) -> Any:
    """Return a ManiSkill environment that renders only on request."""
    backend = render_backend(settings)
    share_vulkan(backend)
    if backend != "none":
        use_lean_shaders()
    try:
        return cls(obs_mode="none", reward_mode="normalized_dense", render_backend=backend, **arguments)
    except RuntimeError as exc:
        missing = _MISSING_FILE.search(str(exc))
        if missing is not None:
            raise MissingDependencyError(
                f"{settings.task}: expected the file {missing[1]}, of which its scene is made, found none. "
                "Put it there, or install the package whole that it belongs to."
            ) from exc
        if backend == "none" or settings.sim_backend == "gpu":
            raise
        raise RenderingError(
            f"{settings.task}: the renderer '{backend}' did not start: {exc}. {RENDERING_ADVICE}"
        ) from exc


Views = Mapping[str, CameraView]
"""By camera."""


def own_views(settings: EnvSettings, n_envs: int) -> list[Views | None]:
    """Return for each environment the views that draw its images; None on a GPU, which draws them at once."""
    if settings.sim_backend == "gpu" or render_backend(settings) != CPU_RENDERER:
        return [None] * n_envs
    known: DenseBodies = {}
    return [{name: CameraView(name, known) for name in settings.cameras} for _ in range(n_envs)]


def describe(env: Any, settings: EnvSettings) -> dict[str, str]:
    """Return the devices of an environment by what they are for."""
    device = {"simulator": str(env.backend.sim_backend)}
    if settings.cameras:
        device["render_backend"] = str(env.backend.render_backend)
        # The first device's name in SAPIEN's own list, such as `llvmpipe (LLVM 15.0.6, 256 bits)`.
        lines = sapien.render.get_device_summary().splitlines()
        names = [str(line.removeprefix("GPU:").strip()) for line in lines if line.startswith("GPU:")]
        device["render_device"] = names[0] if names else "unknown to SAPIEN"
    return device


def take_images(env: Any, cameras: tuple[str, ...], views: Views | None = None) -> dict[str, ImageArray]:
    """Return camera name -> (B, H, W, 3) uint8 of a ManiSkill environment.

    `views` draw the same images faster on a CPU (`own_views`); None: the scene itself is drawn.
    """
    if not cameras:
        raise RenderingError(
            "Images were requested, but this environment was made without cameras and has no renderer. "
            "Name the cameras in EnvSettings.cameras."
        )
    check_no_environment_map(env.scene)
    # All are submitted before the first image is waited for.
    if views is not None:
        for name in cameras:
            views[name].submit(env)
        return {name: views[name].image()[None] for name in cameras}
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    sensors = {name: env.scene.sensors[name] for name in cameras}
    for sensor in sensors.values():
        sensor.capture()
    images = {}
    for name, sensor in sensors.items():
        textures = sensor.get_obs(rgb=True, depth=False, position=False, segmentation=False)
        images[name] = textures["rgb"].cpu().numpy()
    return images


def take_human_image(env: Any) -> ImageArray:
    """Return (B, H, W, 3) uint8 of the camera for viewers; policies' images are not affected."""
    env.scene.update_render(update_sensors=False, update_human_render_cameras=True)
    (camera,) = env.scene.human_render_cameras.values()
    camera.capture()
    textures = camera.get_obs(rgb=True, depth=False, position=False, segmentation=False)
    image: ImageArray = textures["rgb"].cpu().numpy()
    return image
