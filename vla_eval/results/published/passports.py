"""Read the passport of a published result; what its source does not state is unknown."""

from collections.abc import Callable, Collection, Mapping

from vla_eval.errors import ReportError, some_of, unknown_name
from vla_eval.results.passport.fields import FIELDS
from vla_eval.results.passport.passport import Passport
from vla_eval.results.published.literature import Published, PublishedResult

BY_THE_FILE = "success at any step"
"""What every rate of the file is."""

READERS: Mapping[str, Callable[[PublishedResult], object]] = {
    "tasks": lambda one: one.suite,
    "control_mode": lambda one: one.control_mode,
    "image_size": lambda one: None if one.image_px is None else f"{one.image_px} px",
    "robot": lambda one: one.robot,
    "n_action_steps": lambda one: one.n_action_steps,
    "success_rule": lambda _: BY_THE_FILE,
    "training": lambda one: one.training,
    "seeds": lambda one: one.seeds,
    "episodes": lambda one: one.episodes,
    "runs": lambda one: one.runs,
}
"""Field -> how it is read; no source states the others in a form that could be compared."""
STATED_AS: Mapping[str, str] = {"suite": "tasks", "image_px": "image_size"}
"""Field of a published result -> field of a passport, where their names differ."""


def passport_of_published(
    result: PublishedResult, published: Published, *, tasks: Collection[str] = ()
) -> Passport:
    """Return what a source states of how a figure was made; on these tasks alone, if it has any of them."""
    values: dict[str, tuple[str | None, ...]] = {}
    for one in FIELDS:
        read = READERS.get(one.name)
        value = None if read is None else read(result)
        values[one.name] = (None if value is None else str(value),)
    if result.horizon is not None:
        steps = published.boards[result.board].horizon_steps
        own = [task for task in steps if task in tasks] or list(steps)
        values["horizon"] = tuple(dict.fromkeys(f"{steps[task]} control steps" for task in own))
    return Passport(
        subject=f"{name_of(result)} (published)",
        origin=f"{result.source}, {result.where}",
        values=values,
        perhaps={STATED_AS.get(name, name): text for name, text in result.perhaps.items()},
    )


def name_of(result: PublishedResult) -> str:
    """Return the method, with its K where that is stated: `OpenVLA K=8`."""
    k = "" if result.n_action_steps is None else f" K={result.n_action_steps}"
    return f"{result.method}{k}"


def find_published(published: Published, name: str) -> PublishedResult:
    """Return the result of a method, such as `GMP` or `OpenVLA K=8`.

    Raises:
        ReportError: several results have this name.
        UnknownNameError: none has it.
    """
    found = [one for one in published.results if name in (one.method, name_of(one))]
    if not found:
        both = ((one.method, name_of(one)) for one in published.results)
        names = dict.fromkeys(name for pair in both for name in pair)
        raise unknown_name("run folder or published result", name, names, where="passport")
    if len(found) > 1:
        raise ReportError(
            f"{name}: {len(found)} published results have this name. Name one of "
            f"{some_of(map(name_of, found))}."
        )
    return found[0]
