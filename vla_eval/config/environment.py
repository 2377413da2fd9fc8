"""What an environment is made from, as data for a worker; `vla_eval.envs.factory` makes it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import Bounds, check_bounds
from vla_eval.strict.devices import check_device

SimBackend = Literal["cpu", "gpu"]
HUMAN_CAMERA = "human_camera"
"""Name of the camera for people; no policy can request it."""

Simulator = Literal["maniskill", "fake"]
WristMesh = Literal["shipped", "whole", "simplified"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderSettings:
    """How images are rendered."""

    # the mesh of the wrist camera's housing: `shipped` gives the images of ManiSkill's own mesh and leaves
    # out what is hidden inside the housing; `whole` draws that, too (the same images, slower); `simplified`
    # renders a little faster on a CPU and looks a little different
    wrist_mesh: WristMesh = "shipped"
    backend: str = "auto"  # `auto`, `cpu`, `gpu`, or a device as SAPIEN names it (`cuda:1`)

    def __post_init__(self) -> None:
        check_device(self.backend, name="render.backend", renders=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class AppearanceSettings:
    """Changes of light, camera and colours; nothing that moves, and no number of the state, changes."""

    light: Annotated[float, Bounds(0.0, 10.0)] = 1.0  # factor of all lights
    # the base camera stands so much further to the robot's left (+y, world frame)
    camera_shift_m: Annotated[float, Bounds(-0.5, 0.5)] = 0.0
    # it is turned by so much about the vertical, counterclockwise seen from above
    camera_turn_deg: Annotated[float, Bounds(-45.0, 45.0)] = 0.0
    # the table has a plain top of this red, green and blue instead of wood; None: wood
    table_rgb: Annotated[tuple[float, ...] | None, Bounds(0.0, 1.0)] = None
    # the hue of every object of the task is so much further on the circle of hues. Red is 0, green 120,
    # blue 240.
    hue_deg: Annotated[float, Bounds(-180.0, 180.0)] = 0.0

    def __post_init__(self) -> None:
        check_bounds(self, prefix="appearance.")
        if self.table_rgb is not None and len(self.table_rgb) != 3:
            raise RecipeError(f"appearance.table_rgb is {list(self.table_rgb)}, expected three numbers.")


AS_DESIGNED = AppearanceSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvSettings:
    """One environment object; two equal settings give interchangeable environments."""

    task: str  # its id
    # the user's task arguments, of whatever types; they go on top of the catalogue row's own
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    simulator: Simulator = "maniskill"  # or `fake`: arrays only, for tests and dry runs
    sim_backend: SimBackend = "cpu"
    render: RenderSettings = field(default_factory=RenderSettings)
    appearance: AppearanceSettings = AS_DESIGNED
    cameras: tuple[str, ...] = ()  # those that may be rendered; empty: no renderer is started
    privileged: bool = False  # whether observations carry the true state of the world
    # at the reset and every so many control steps, images include the view for people; None: never
    human_camera_stride: int | None = None
    n_slots: int = 1  # how many episodes run side by side

    def shows_human_camera(self, step: int, horizon_steps: int) -> bool:
        """Whether the images of a step include the view for people."""
        stride = self.human_camera_stride
        return stride is not None and (step % stride == 0 or step == horizon_steps)
