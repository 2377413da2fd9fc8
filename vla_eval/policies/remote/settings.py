"""The arguments of a `policies/remote_*.yaml`: where the server is, and how both ends' names correspond."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal  # Any: what a recipe holds

from vla_eval.config.files import digest_of, to_data
from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import MAX_SECONDS, check_bounds, require
from vla_eval.strict.decoding import decode
from vla_eval.wire.metadata import MAX_ACTIONS, MAX_IMAGE_PX

ADAPTER = "remote"
DEFAULT_KEY_ENV = "MIKASA_VLA_API_KEY"
PLACE_FIELDS = ("url", "timeout_seconds", "connect_seconds", "api_key_env")
"""Where a policy is and how long it is waited for: no part of what it is."""

Dialect = Literal["openpi", "vla_eval"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """How the image of a camera is sent."""

    key: str
    # `height_px`, `width_px`: the size that the server wants; None: as the server says, else the
    # camera's
    height_px: int | None = None
    width_px: int | None = None
    # how to make that size of another one: `pad` keeps the proportions and fills with black at two
    # sides, `plain` does not keep them. None: another size is an error.
    resize: Literal["pad", "plain"] | None = None

    def __post_init__(self) -> None:
        require(bool(self.key), "cameras.key", self.key, "the name of the image in a request")
        check_bounds(self, {"height_px": (1, MAX_IMAGE_PX), "width_px": (1, MAX_IMAGE_PX)}, prefix="cameras.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionSettings:
    """What the server's actions mean, where it is something else than at this environment."""

    # which value of the last number opens and closes
    gripper: Literal["open_positive", "close_positive", "open_01", "close_01"] = "open_positive"
    # how the second three numbers describe a turn
    rotation: Literal["euler_xyz", "axis_angle"] = "euler_xyz"
    position_unit_m: float | None = None  # what 1 means in the first three numbers; None: as here
    rotation_unit_rad: float | None = None  # what 1 means in the second three; None: as here

    def __post_init__(self) -> None:
        bounds = {"position_unit_m": (1e-4, 10.0), "rotation_unit_rad": (1e-4, 10.0)}
        check_bounds(self, bounds, prefix="actions.")
        has_unit = self.rotation_unit_rad is not None
        require(
            self.rotation == "euler_xyz" or has_unit,
            "actions.rotation_unit_rad",
            None,
            "a number: without its unit an axis-angle cannot be converted",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteSettings:
    """The arguments of the adapter `remote`; `docs/remote.md` has the table."""

    url: str  # `ws://HOST:PORT`; several with commas are servers of the same policy
    # `openpi`, or `vla_eval` for the model servers of allenai's vla-evaluation-harness
    dialect: Dialect = "openpi"
    # our name of a camera -> how it is sent; None: as the server says
    cameras: dict[str, CameraSettings] | None = None
    # key in a request -> layout; None: as the server says. Empty: no state is sent.
    state: dict[str, str] | None = None
    prompt_key: str | None = None  # key of the instruction; None: as the server says, else `prompt`
    chunk_size: int | None = None  # actions of one reply; None: as the server says
    # whether the policy must see each control step; None: as the server says
    reads: Literal["last", "every"] | None = None
    actions: ActionSettings | None = None  # what the server's actions mean; None: the same as here
    timeout_seconds: float = 120.0  # how long a reply is waited for
    connect_seconds: float = 30.0  # how long a worker waits for a server that does not listen yet
    api_key_env: str | None = None  # the environment variable with the API key

    def __post_init__(self) -> None:
        check_bounds(
            self,
            {
                "chunk_size": (1, MAX_ACTIONS),
                "timeout_seconds": (0.001, MAX_SECONDS),
                "connect_seconds": (0.0, MAX_SECONDS),
            },
        )

    @property
    def api_key(self) -> str | None:
        """The API key; None if there is none. A variable that the recipe names has to be set."""
        key = os.environ.get(self.api_key_env or DEFAULT_KEY_ENV)
        if self.api_key_env is not None and not key:
            raise RecipeError(
                f"api_key_env: the environment variable {self.api_key_env:.80} is not set. Put the server's "
                f"API key into it."
            )
        return key or None


def remote_settings(args: Mapping[str, Any], *, where: str) -> RemoteSettings:
    """Read the arguments of a recipe strictly."""
    return decode(RemoteSettings, args, where=where)


def settings_digest(settings: RemoteSettings) -> str:
    """Return the digest of what moves a result: neither where the server is nor how long it may take."""
    data = to_data(settings)
    return digest_of({name: value for name, value in data.items() if name not in PLACE_FIELDS})
