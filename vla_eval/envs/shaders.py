"""Leave out of SAPIEN's shaders the one table that no task uses and that costs ten seconds per process.

SAPIEN computes it (`samplerBRDFLUT`, for reflections of an environment map) when a process renders its first
image: 9 to 10 s of a CPU core with Mesa's lavapipe. No task sets an environment map; the table is then
multiplied by 0, so images without it are equal to the bit. The installed files are copied and changed, or
used unchanged if they are not as expected: slower, with the same images.
"""

import functools
import hashlib
import logging
import re
import shutil
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import sapien

from vla_eval.errors import RenderingError
from vla_eval.storage.cache import cache_dir
from vla_eval.storage.drafts import appearing

logger = logging.getLogger(__name__)

SHADERS = "vulkan_shader"  # folder of the package sapien (3.0.3)
PACKS = ("minimal", "default")  # of cameras that policies see through, and of those for people
TABLE = "samplerBRDFLUT"
_DECLARATION = re.compile(rf"^layout\([^)]*\) uniform sampler2D {TABLE};\n?", re.MULTILINE)
_READING = re.compile(rf"texture\({TABLE}, vec2\(roughness, dotNV\)\)\.xy")


@functools.cache
def use_lean_shaders() -> bool:
    """Let SAPIEN compile shaders without the table, from now on; return whether it does."""
    try:
        folder = _lean_copy(Path(str(resources.files(sapien) / SHADERS)))
    except OSError as exc:
        logger.warning("the shaders are used as installed: no copy could be written (%s)", exc)
        return False
    if folder is None:
        logger.warning(
            "the shaders are used as installed: those of sapien %s are not known", sapien.__version__
        )
        return False
    # sapien's own __init__ sets the folder by this call; there is no public one.
    sapien.pysapien.render._internal_set_shader_search_path(str(folder))
    return True


def check_no_environment_map(scene: Any) -> None:  # Any: a ManiSkill scene
    """Raise `RenderingError` if the scene reflects its surroundings, which the lean shaders leave out."""
    if any(one.render_system.cubemap is not None for one in scene.sub_scenes):
        raise RenderingError(
            "the scene has an environment map, expected none: its reflections would be missing. "
            "Light the scene with lamps and ambient light instead."
        )


def _lean_copy(installed: Path) -> Path | None:
    """Return a folder with a copy of the shaders without the table; None if they are not what is expected."""
    lean = dict(_lean_texts(installed))
    if not lean or any(TABLE in text for text in lean.values()):
        return None
    digest = hashlib.sha256()
    for path in sorted(installed.rglob("*")):
        if path.is_file():
            name = path.relative_to(installed).as_posix()
            digest.update(f"{name}\0{lean.get(name) or path.read_text(encoding='utf-8')}\0".encode())
    folder = cache_dir() / "shaders" / digest.hexdigest()
    if not folder.is_dir():
        with appearing(folder) as draft:
            shutil.copytree(installed, draft, dirs_exist_ok=True)
            for name, text in lean.items():
                (draft / name).write_text(text, encoding="utf-8")
    return folder


def _lean_texts(installed: Path) -> Iterator[tuple[str, str]]:
    """Yield name and changed text of each file that mentions the table."""
    for pack in PACKS:
        for path in sorted((installed / pack).iterdir()):
            text = path.read_text(encoding="utf-8")
            if TABLE in text:
                changed = _READING.sub("vec2(0)", _DECLARATION.sub("", text))
                yield path.relative_to(installed).as_posix(), changed
