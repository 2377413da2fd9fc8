"""Find, read strictly and hash the YAML recipes; turn them into frozen dataclasses.

A recipe is a file in one of five folders: `configs/`, `policies/`, `prompts/`, `datasets/`, `protocols/`. It
is found by a given path, then in the working directory's folder, then among the ones that come with the
package. Knows nothing of what the recipes mean.
"""

import dataclasses
import hashlib
import json
import os
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import vla_eval
from vla_eval.errors import MAX_SHOWN, RecipeError, UnknownNameError, did_you_mean, unknown_name
from vla_eval.records import is_name
from vla_eval.strict.bounds import require
from vla_eval.strict.decoding import decode, set_field
from vla_eval.strict.yaml_data import MAX_CHARACTERS, load_yaml

PACKAGE_ROOT = Path(vla_eval.__file__).parent
Folder = Literal["configs", "policies", "prompts", "datasets", "protocols"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe[T]:
    """A recipe and where it came from."""

    name: str  # the file's name without `.yaml`
    path: Path
    sha256: str  # digest of the file's bytes
    value: T


def check_run_name(name: str) -> None:
    """Raise `RecipeError` unless the name can be the name of a folder on any machine."""
    allowed = name and name[0].isalnum() and all(c.isalnum() or c in "._-" for c in name) and name.isascii()
    require(bool(allowed), "name", repr(name), "letters, digits, '.', '_' and '-', a letter or digit first")


def check_recorded_name(name: str, *, kind: str) -> None:
    """Raise `RecipeError` unless tables, paths and spreadsheets can hold a recipe's name as it is."""
    if not (is_name(name) and (name[:1].isalnum() or name[:1] == "_")):
        raise RecipeError(
            f"{kind}: the file is called {name!r:.200}, expected a name that begins with a letter, a digit "
            f"or '_' and has neither '/' nor '\\', no line breaks and no other control characters. Rename "
            f"the file."
        )


def search_folders(kind: str) -> tuple[Path, ...]:
    """Return the folders with files of a kind (`configs`, `datasets` …): the user's, the package's."""
    packaged = PACKAGE_ROOT / "recipes_data" / kind
    # An editable checkout has no recipes_data: these folders are next to the package.
    shipped = packaged if packaged.is_dir() else PACKAGE_ROOT.parent / kind
    return tuple(dict.fromkeys((Path.cwd() / kind, shipped)))


def list_recipes(folder: Folder) -> dict[str, Path]:
    """Return name -> file of all recipes of a kind; the working directory's hide the package's."""
    found: dict[str, Path] = {}
    for place in reversed(search_folders(folder)):
        found.update({path.stem: path for path in sorted(place.glob("*.yaml"))})
    return dict(sorted(found.items()))


def shipped_digests() -> dict[str, str]:
    """Return `policies/act` -> sha256 of its file, of all recipes that come with the package."""
    return {
        f"{folder}/{path.stem}": hashlib.sha256(path.read_bytes()).hexdigest()
        for folder in get_args(Folder)
        for path in sorted(search_folders(folder)[-1].glob("*.yaml"))
    }


def find_recipe(folder: Folder, name: str) -> Path:
    """Return the file of a recipe, by its path or its name, or raise `UnknownNameError`."""
    as_path = Path(name)
    # os.path, unlike Path, returns False for what cannot be a path: too long, or with a NUL.
    if as_path.suffix in (".yaml", ".yml") and os.path.isfile(as_path):
        return as_path
    known = list_recipes(folder)
    stem = name.removeprefix(f"{folder}/").removesuffix(".yaml")
    if stem in known:
        return known[stem]
    if "/" in stem or (as_path.suffix in (".yaml", ".yml") and not did_you_mean(stem, known)):
        raise no_such_path(name, f"mikasa-vla list {folder}")
    raise unknown_name(f"{folder}/*.yaml", name, known)


def no_such_path(name: str, command: str) -> UnknownNameError:
    """Build the error for a path to nothing, with the command that lists names."""
    is_id = command.endswith("policies") and re.fullmatch(r"[\w.-]+/[\w.-]+", name)
    on_hub = f" If it is on the Hub: hub:{name}@REVISION." if is_id else ""
    return UnknownNameError(
        f"{name:.{MAX_SHOWN}}: there is no such file or folder in {Path.cwd()}. Expected the path of one, or "
        f"a name of `{command}`.{on_hub}"
    )


def load_recipe[T](
    folder: Folder, name: str, cls: type[T], *, edit: Callable[[dict[str, Any]], None] | None = None
) -> Recipe[T]:
    """Find a recipe, read it strictly, and return it as an object of the dataclass of its kind.

    `edit` changes what the file says, before it is checked (flags and overrides).

    Raises:
        UnknownNameError: there is no such recipe.
        RecipeError: it cannot be read, has unknown or missing fields, or values of a wrong type.
    """
    file = _read(folder, name)
    if edit is not None:
        edit(file.data)
    value = decode(cls, file.data, where=file.where)
    return Recipe(name=file.path.stem, path=file.path, sha256=file.sha256, value=value)


def recipe_fields(folder: Folder, name: str) -> frozenset[str]:
    """Return which fields a recipe sets, which show its kind; errors as `load_recipe`."""
    return frozenset(_read(folder, name).data)


class _File(NamedTuple):
    """A recipe as it was read, not yet checked."""

    path: Path
    where: str
    sha256: str
    data: dict[str, Any]  # Any: plain data of YAML


def _read(folder: Folder, name: str) -> _File:
    path = find_recipe(folder, name)
    check_recorded_name(path.stem, kind=folder)
    where = f"{folder}/{path.name}" if path.parent in search_folders(folder) else str(path)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_CHARACTERS * 4 + 1)  # one more than UTF-8 needs: refused as too large
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise RecipeError(f"{where}: cannot be read as a text file in UTF-8 ({exc}).") from exc
    data = load_yaml(text, where=where)
    if not isinstance(data, dict):
        raise RecipeError(f"{where}: expected fields with values (`name: …`), found {data!r:.60}.")
    return _File(path, where, hashlib.sha256(content).hexdigest(), data)


def apply_overrides(
    data: dict[str, Any],
    overrides: Sequence[str],
    *,
    cls: type,
    free: Mapping[str, Sequence[str]] = types.MappingProxyType({}),
) -> None:
    """Change `data` in place by `a.b=c` each, c read as YAML; for `free`, see `set_field`."""
    for override in overrides:
        path, equals, text = override.partition("=")
        where = f"--set {override:.{MAX_SHOWN}}"
        if not equals or not all(path.split(".")):
            raise RecipeError(f"{where}: expected FIELD=VALUE, for example --set chunking.delay=2.")
        set_field(cls, data, path, load_yaml(text, where=where), where=where, free=free)


def to_data(value: Any) -> Any:  # Any: plain data of whatever the recipe holds
    """Return a recipe's value as plain data: mappings, lists, strings, numbers, booleans, None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_data(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_data(item) for item in value]
    return value


def content_of(value: Any, *, options: Sequence[str]) -> dict[str, Any]:  # Any: a recipe, its plain data
    """Return the fields of a recipe as plain data without its options, on which no content depends."""
    data: dict[str, Any] = to_data(value)
    return {name: item for name, item in data.items() if name not in options}


def options_of(value: Any, *, options: Sequence[str]) -> dict[str, Any]:  # Any: a recipe, its plain data
    """Return the options of a recipe as plain data."""
    data: dict[str, Any] = to_data(value)
    return {name: data[name] for name in options}


def digest_of(data: Any) -> str:  # Any: plain data
    """Return the sha256 of plain data, written as ASCII JSON with sorted keys."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, ensure_ascii=True).encode()).hexdigest()
