"""A passport: how one figure was made, and whether two figures may stand side by side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from vla_eval.results.passport.fields import FIELDS, SETTINGS, Field
from vla_eval.seeding import SeedRange

UNKNOWN = "unknown"
MAX_SHOWN = 4  # values of one field in a sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Passport:
    """How a figure, or the figures of a run folder, was made, as far as it is known."""

    subject: str  # whose figure it is: `memory on RememberColor3-v0 K=4`, `GMP (published)`
    # figures of one origin share what it does not state: the run folder, or the table of a source
    origin: str
    # name of a field -> its value, several if there are several figures; None is unknown
    values: Mapping[str, tuple[str | None, ...]]
    # name of a field -> what may hold of it, and from where that is
    perhaps: Mapping[str, str] = field(default_factory=dict)

    def known(self, name: str) -> bool:
        """Whether a field is known for all figures."""
        found = self.values.get(name, ())
        return bool(found) and None not in found

    def text(self, name: str) -> str:
        """Return the value of a field for people; `unknown`, with what may hold, if it is not known."""
        found = self.values.get(name) or (None,)
        perhaps = f", perhaps {self.perhaps[name]}" if name in self.perhaps else ""
        return "; ".join(f"{UNKNOWN}{perhaps}" if one is None else one for one in found)

    def to_dict(self) -> dict[str, str | list[str | None] | None]:
        """Return the values by field, null where one is not known; a list where there are several."""
        found: dict[str, str | list[str | None] | None] = {}
        for one in FIELDS:
            values = self.values[one.name]
            found[one.name] = values[0] if len(values) == 1 else list(values)
        return found

    @property
    def standing(self) -> tuple[object, ...]:
        """What is equal in figures that may be ranked: the settings, and the origin of those not known."""
        return tuple(
            self.values[one.name] if self.known(one.name) else (self.values[one.name], self.origin)
            for one in SETTINGS
        )


def seeds_text(seeds: Iterable[SeedRange]) -> str:
    """Return `1 to 100, 200`; empty without a seed."""
    return ", ".join(
        str(one.first) if one.first == one.last else f"{one.first} to {one.last}" for one in seeds
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A field in which two passports differ, or which is not known of both."""

    field: Field
    values: tuple[str, ...]
    is_known: bool  # whether both are known, so that it is certain that they differ


def differences(first: Passport, second: Passport) -> tuple[Difference, ...]:
    """Return what differs between two passports, or is not known of one or both, in the table's order."""
    found = []
    for one in FIELDS:
        both = first.values.get(one.name) or (None,), second.values.get(one.name) or (None,)
        is_known = first.known(one.name) and second.known(one.name)
        is_same = set(both[0]) == set(both[1])
        if is_same and (is_known or first.origin == second.origin):
            continue
        texts = (first.text(one.name), second.text(one.name))
        found.append(Difference(field=one, values=texts, is_known=is_known))
    return tuple(found)


def classes(passports: Iterable[Passport]) -> list[list[Passport]]:
    """Sort figures into those that may be ranked against each other, in the order of their first ones."""
    found: dict[tuple[object, ...], list[Passport]] = {}
    for one in passports:
        found.setdefault(one.standing, []).append(one)
    return list(found.values())


def merged(passports: Sequence[Passport], *, subject: str) -> Passport:
    """Return the passport of several figures of one origin; there is at least one."""
    values = {
        one.name: tuple(
            dict.fromkeys(value for of in passports for value in of.values.get(one.name, (None,)))
        )
        for one in FIELDS
    }
    first = passports[0]
    return Passport(subject=subject, origin=first.origin, values=values)
