"""What the JSON of a glTF file says before its numbers are read; callers expect its values to be anything."""

import json
import struct
from typing import Any  # JSON

from vla_eval.errors import some_of
from vla_eval.tasks.objects.mesh_folder import UnusableMeshError

MAX_PARTS, MAX_NUMBERS = 1_000, 10_000_000  # nodes and meshes; numbers of its accessors


def gltf_header(content: bytes) -> dict[str, Any]:
    """Return the JSON of a glTF file, binary or not."""
    if content[:4] == b"glTF":
        (n_bytes,) = struct.unpack("<I", content[12:16])
        content = content[20 : 20 + n_bytes]
    header = json.loads(content)
    if not isinstance(header, dict):
        raise UnusableMeshError("it is no glTF: its JSON is not an object. Export it again")
    return header


def check_gltf(header: dict[str, Any]) -> None:
    """Refuse a small file that asks for very much memory, and what trimesh does not know."""
    n_parts = sum(len(header.get(name, ())) for name in ("nodes", "meshes"))
    n_children = sum(len(node.get("children", ())) for node in header.get("nodes", ()))
    counts = [accessor["count"] for accessor in header.get("accessors", ())]
    if max(n_parts, n_children) > MAX_PARTS or sum(counts) > MAX_NUMBERS:
        raise UnusableMeshError("it has more parts or numbers than a thing on a table needs. Simplify it")
    if header.get("extensionsRequired"):
        needed = some_of(header["extensionsRequired"])
        raise UnusableMeshError(f"it needs extensions of glTF ({needed:.120}). Export it without them")


def n_textured(header: dict[str, Any]) -> int:
    """Return how many parts of the scene have a texture."""
    nodes, scenes = header.get("nodes", []), header.get("scenes", [])
    open_ends = list(scenes[header.get("scene", 0)].get("nodes", [])) if scenes else []
    reached: set[int] = set()
    while open_ends:
        node = open_ends.pop()
        if node not in reached:
            reached.add(node)
            open_ends += nodes[node].get("children", [])
    textured = {
        index
        for index, one in enumerate(header.get("materials", []))
        if "baseColorTexture" in one.get("pbrMetallicRoughness", {})
    }
    meshes = [header["meshes"][nodes[node]["mesh"]] for node in reached if "mesh" in nodes[node]]
    return sum(part.get("material") in textured for mesh in meshes for part in mesh["primitives"])
