"""Find files that come with the package: recipes and small trained weights. Standard library only."""

from pathlib import Path

import vla_eval

PACKAGE_ROOT = Path(vla_eval.__file__).parent


def search_folders(kind: str) -> tuple[Path, ...]:
    """Return the folders with files of a kind (`configs`, `datasets` …): the user's, the package's."""
    packaged = PACKAGE_ROOT / "recipes_data" / kind
    # An editable checkout has no recipes_data: these folders are next to the package.
    shipped = packaged if packaged.is_dir() else PACKAGE_ROOT.parent / kind
    return tuple(dict.fromkeys((Path.cwd() / kind, shipped)))
