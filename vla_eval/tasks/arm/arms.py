"""How the render option `wrist_mesh` selects among the Panda's variants. Knows nothing of simulators."""

from vla_eval.config.environment import WristMesh
from vla_eval.robots.rows import PANDA

_SEEN, _WHOLE, _LIGHT = PANDA.uids
WRIST_MESH_ROBOTS: dict[WristMesh, str] = {"shipped": _SEEN, "whole": _WHOLE, "simplified": _LIGHT}
"""Value of the render option `wrist_mesh` -> robot uid of the Panda with that mesh."""
