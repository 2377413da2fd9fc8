"""Read the surfaces of a mesh by trimesh, from bytes; what it names besides itself is read from its folder.

Nothing else is opened, nothing is fetched, and nothing is repaired. trimesh hides what it cannot read; here
it is an error. Knows nothing of what a task can use.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any  # glTF's JSON; trimesh's materials have no types
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.resolvers import Resolver

from vla_eval.tasks.objects.mesh_folder import FolderFiles, UnusableMeshError
from vla_eval.tasks.objects.mesh_gltf import check_gltf, gltf_header, n_textured
from vla_eval.tasks.objects.solids import RGB, Surface

MAX_TRIANGLES = 100_000
MAX_TEXTURE_PX = 4096
MAX_PLACE_M = 1e6
PLAIN_RGB = (150, 150, 150)  # of a mesh without a material
Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""From the axes of glTF, whose specification has y up (2.0, section 3.4), to z up."""


def read_surfaces(files: FolderFiles, file: PurePosixPath, *, scale: float) -> list[Surface]:
    """Return the surfaces of one mesh, in metres, z up; its sizes are multiplied by `scale`.

    Raises:
        UnusableMeshError: it cannot be read, or not all of it; without a full stop.
    """
    content, kind = files.content(file), file.suffix.lower().removeprefix(".")
    resolver = _OfFolder(files, file.parent, names_images=kind == "obj")
    header: dict[str, Any] | None = None
    with reading():
        if kind in ("glb", "gltf"):
            header = gltf_header(content)
            check_gltf(header)
        scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, resolver=resolver, process=False)
        found = scene.dump(concatenate=False)
    if resolver.problem is not None:
        raise resolver.problem
    parts = [part for part in found if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts or len(parts) < len(found):
        raise UnusableMeshError(
            "expected triangles, found none, or parts that are points or lines. Export triangles"
        )
    n_triangles = sum(len(part.faces) for part in parts)
    if n_triangles > MAX_TRIANGLES:
        raise UnusableMeshError(
            f"it has {n_triangles} triangles, expected at most {MAX_TRIANGLES}. Simplify it"
        )
    with reading():
        turn = np.eye(3) if header is None else Y_UP
        surfaces = [_surface(part, turn=turn, scale=scale) for part in parts]
        n_wanted = 0 if header is None else n_textured(header)
    if sum(one.texture is not None for one in surfaces) < n_wanted:  # trimesh hides what it cannot read
        raise UnusableMeshError("a texture of it cannot be read; expected PNG or JPEG. Export it again")
    return surfaces


class _OfFolder(Resolver):
    """Gives trimesh what a mesh names; trimesh hides errors, so the first one is kept here."""

    def __init__(self, files: FolderFiles, base: PurePosixPath, *, names_images: bool) -> None:
        self._files, self._base, self._names_images = files, base, names_images
        self.problem: UnusableMeshError | None = None

    def get(self, key: str) -> bytes:
        """Return the content of a file, named relative to the mesh."""
        try:
            return self._content(key)
        except UnusableMeshError as exc:
            self.problem = self.problem or exc
            raise

    def _content(self, key: str) -> bytes:
        if "://" in key:
            raise UnusableMeshError(
                f"it names {key!r:.120}, and nothing is fetched. Put the file into the folder"
            )
        content = self._files.content(self._base / unquote(key).replace("\\", "/"))
        if self._names_images and not key.lower().endswith(".mtl"):
            _opened(content, key)
        return content

    def write(self, name: str, data: object) -> None:
        """Nothing is written."""
        raise OSError(f"{name}: nothing is written")

    def namespaced(self, namespace: str) -> "_OfFolder":
        """Return that of a folder in it."""
        return _OfFolder(self._files, self._base / namespace, names_images=self._names_images)

    def keys(self) -> tuple[str, ...]:
        """List nothing: a mesh has to name what it uses."""
        return ()


def _opened(content: bytes, name: str) -> None:
    try:
        _check_image(Image.open(io.BytesIO(content)), name)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as exc:
        raise UnusableMeshError(f"its image {name!r:.120} cannot be read. Export it as PNG") from exc


def _check_image(image: Image.Image, name: str) -> None:
    if max(image.size) > MAX_TEXTURE_PX:
        raise UnusableMeshError(
            f"its image {name!r:.120} has {image.width} x {image.height} pixels, expected at most "
            f"{MAX_TEXTURE_PX} along an edge. Make it smaller"
        )
    image.load()


@contextlib.contextmanager
def reading() -> Iterator[None]:
    """Let whatever a damaged file makes trimesh and numpy raise become one message."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # what it would warn of is an error here
    try:
        with warnings.catch_warnings():
            # numpy warns of text that is no row of numbers, which trimesh then reads otherwise, or refuses
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    except UnusableMeshError:
        raise
    except Exception as exc:
        reason = f"{type(exc).__name__}: {exc}".splitlines()[0]
        raise UnusableMeshError(f"it cannot be read as a mesh ({reason:.120}). Export it again") from exc
    finally:
        logger.setLevel(level)


def _surface(part: trimesh.Trimesh, *, turn: NDArray[np.float64], scale: float) -> Surface:
    vertices = np.asarray(part.vertices, dtype=np.float64) @ turn.T * scale
    if not (np.abs(vertices) <= MAX_PLACE_M).all():  # nor is it true of what is no number
        raise UnusableMeshError(
            "it has corners whose places are no numbers, or more than 1,000 km away. Export it again"
        )
    triangles = np.asarray(part.faces, dtype=np.uint32)
    rgb, texture = _material(part.visual)
    uvs = np.zeros((len(vertices), 2)) if texture is None else np.asarray(getattr(part.visual, "uv", None))
    if uvs.shape != (len(vertices), 2) or not np.isfinite(uvs).all():
        raise UnusableMeshError("it has a texture, but no finite texture coordinates. Export it again")
    if "vertex_normals" in part._cache.cache:  # in the file
        normals = np.asarray(part.vertex_normals) @ turn.T
    else:  # flat ones, as glTF's specification says (3.7.2.1); each triangle has corners of its own then
        order = triangles.ravel()
        normals = np.repeat(np.asarray(part.face_normals) @ turn.T, 3, axis=0)
        vertices, uvs = vertices[order], uvs[order]
        triangles = np.arange(len(order), dtype=np.uint32).reshape(-1, 3)
    return Surface(
        vertices_m=vertices.astype(np.float32),
        triangles=triangles,
        normals=np.ascontiguousarray(normals, dtype=np.float32),
        uvs=np.asarray(uvs, dtype=np.float32),
        rgb=rgb,
        texture=texture,
    )


def _material(visual: Any) -> tuple[RGB, NDArray[np.uint8] | None]:
    """Return colour and texture; `PLAIN_RGB` if the file gives none."""
    if visual.kind in ("vertex", "face"):
        colors = np.unique(
            visual.face_colors[:, :3] if visual.kind == "face" else visual.vertex_colors[:, :3], axis=0
        )
        if len(colors) > 1:
            raise UnusableMeshError(
                f"it has colours of single corners or triangles ({len(colors)} of them), which are not "
                "drawn. Bake them into a texture, or give each colour a material"
            )
        return _rgb(colors[0]), None
    material = getattr(visual, "material", None)
    if material is None:
        return PLAIN_RGB, None
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = getattr(material, "baseColorFactor", None)
    if color is None:
        color = getattr(material, "diffuse", None)
    white = np.array([255, 255, 255])
    if image is None:
        return _rgb(white if color is None else color), None
    _check_image(image, "of a material")
    is_factor = hasattr(material, "baseColorFactor")  # in MTL files, a texture replaces the colour
    return _rgb(color if is_factor and color is not None else white), np.asarray(image.convert("RGBA"))


def _rgb(color: Any) -> RGB:
    red, green, blue = (int(channel) for channel in np.asarray(color)[:3])
    return red, green, blue
