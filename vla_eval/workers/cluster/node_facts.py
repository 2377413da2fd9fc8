"""What a machine of a cluster has, found on that machine; and whether it can be used with this one."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vla_eval.config.files import digest_of, shipped_digests
from vla_eval.storage.provenance import collect_environment, vulkan_drivers
from vla_eval.storage.run_file import JsonValue, find_changes
from vla_eval.workers.needed_files import Needed
from vla_eval.workers.parcel import PackedFolder, unpack
from vla_eval.workers.start import available_ram_bytes, visible_gpus

KIND_FACTS = ("cpu", "mesa", "nvidia_driver")
"""What may move the last bits of a state or a pixel while code and packages are the same."""
KIND_DIGITS = 8  # of a digest, for people
LEAST_FREE_BYTES = 1 << 30  # a worker with simulator and policy has more
GB = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeFacts:
    """What there is on a machine."""

    # commit, package versions, CPU, drivers; see `collect_environment`
    environment: Mapping[str, JsonValue]
    vulkan: tuple[str, ...]
    free_bytes: int
    n_gpus: int  # GPUs with a driver
    missing: tuple[str, ...] = ()  # what is wrong with the files that it was asked for
    absent: tuple[str, ...] = ()  # folders that it was asked for, does not have, and can be sent
    # `policies/act` -> sha256, of the recipes of its package
    recipes: Mapping[str, JsonValue] = field(default_factory=dict)

    @property
    def kind(self) -> dict[str, JsonValue]:
        """What bits may depend on."""
        return {name: self.environment.get(name) for name in KIND_FACTS}

    @property
    def recipes_name(self) -> str:
        """The beginning of a digest of all recipes."""
        return digest_of(dict(self.recipes))[:KIND_DIGITS]

    @property
    def kind_name(self) -> str:
        """A short name of the kind, the same wherever the kind is the same."""
        return digest_of(self.kind)[:KIND_DIGITS]


def node_facts(needs: tuple[Needed, ...] = (), *, folder: str = ".") -> NodeFacts:
    """Return the facts of this machine; `folder` is the planning machine's working directory."""
    with contextlib.chdir(folder) if Path(folder).is_dir() else contextlib.nullcontext():
        missing = tuple(wrong for need in needs if (wrong := need.objection()) is not None)
        absent = tuple(dict.fromkeys(path for need in needs for path in need.absent()))
    return NodeFacts(
        environment=collect_environment(),
        vulkan=vulkan_drivers(),
        free_bytes=available_ram_bytes(),
        n_gpus=len(visible_gpus()),
        missing=missing,
        absent=absent,
        recipes=dict(shipped_digests()),
    )


def receive(folders: Sequence[PackedFolder], needs: tuple[Needed, ...], *, folder: str) -> NodeFacts:
    """Write the folders that this machine did not have, in their order, and return its facts again."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with contextlib.chdir(folder):
            for packed in folders:
                unpack(packed)
    except OSError as exc:
        found = node_facts(needs, folder=folder)
        return replace(found, missing=(*found.missing, f"a checkpoint cannot be written there ({exc})"))
    return node_facts(needs, folder=folder)


def objections(found: NodeFacts, expected: NodeFacts, *, allow_other_kind: bool) -> tuple[str, ...]:
    """Return why a machine with the facts `found` cannot be used with the planning one; none: it can."""
    wrong = [str(change) for change in find_changes(_code(expected), _code(found), prefix="")]
    if not allow_other_kind and (changes := find_changes(expected.kind, found.kind, prefix="")):
        listed = "; ".join(map(str, changes))
        wrong.append(f"another kind of machine ({listed}): --allow-environment-change accepts it")
    if expected.vulkan and not found.vulkan:
        wrong.append("no Vulkan driver: `mikasa-vla doctor` there says what to install")
    if found.free_bytes < LEAST_FREE_BYTES:
        wrong.append(
            f"{found.free_bytes / GB:.1f} GB of memory are free, expected {LEAST_FREE_BYTES / GB:.1f}"
        )
    return (*wrong, *found.missing)


def _code(facts: NodeFacts) -> dict[str, JsonValue]:
    own = {name: value for name, value in facts.environment.items() if name not in KIND_FACTS}
    return {**own, "recipes": dict(facts.recipes)}
