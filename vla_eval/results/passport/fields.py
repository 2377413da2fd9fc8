"""The fields of a passport, a row each: where a run has it, and what a difference may do to success.

Knows nothing of how a run or a published result is read.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

Kind = Literal["setting", "environment", "evidence"]
"""A setting affects success: rows that differ in one are not ranked. An environment may affect it, and is
named. Evidence is what the figure is estimated from."""

NOT_MEASURED = "not measured here"


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field of a passport."""

    name: str  # in JSON, and in what a published result states or leaves out
    words: str  # for people
    kind: Kind
    # leaves of `run.json` that it consists of, or mappings of them; of its configuration for a setting, of
    # its environment for an environment. The longest one that fits decides.
    paths: tuple[str, ...] = ()
    effect: str = NOT_MEASURED  # what a difference does to success
    page: str | None = None  # where the figures in `effect` were measured


FIELDS: tuple[Field, ...] = (
    Field(
        name="tasks",
        words="tasks",
        kind="setting",
        effect="tasks of one name differ: `memory` has 0.89 on InterceptMedium here and 0.86 in the official "
        "code; those with -VLA-v0 have other phases and horizons",
        page="leaderboard.md",
    ),
    Field(name="instructions", words="instructions", kind="setting", paths=("prompt_set",)),
    Field(
        name="control_mode",
        words="control mode",
        kind="setting",
        paths=("env.control_mode",),
        effect="on TakeItBack the expert needs 59.4 control steps in joint deltas, 18.4 in the others; "
        "the success of learned policies was not compared",
        page="control_modes.md",
    ),
    Field(name="image_size", words="image size", kind="setting", paths=("env.image_size",)),
    Field(
        name="robot",
        words="robot",
        kind="setting",
        paths=("env.robot", "env.robot_uids"),
        effect="`oracle` has 1.00 on ShellGameTouch with the SO-100, and 0.65 with Fetch, which does not "
        "reach all mugs",
        page="robots.md",
    ),
    Field(
        name="horizon",
        words="horizon",
        kind="setting",
        paths=("env.horizon_steps",),
        effect="a longer episode leaves more time, and success once can only grow: `memory_color3` at "
        "K = 8 has 1.00 in 60 control steps, 0.58 in 40",
        page="passport.md",
    ),
    Field(
        name="n_action_steps",
        words="K",
        kind="setting",
        effect="on RememberColor3 `recurrent` has 0.90, 0.80 and 0.25 at K = 1, 4 and 8, `memory_color3` "
        "1.00 at each",
        page="chunk_sizes.md",
    ),
    Field(
        name="execution",
        words="execution",
        kind="setting",
        paths=("chunking",),
        effect="at a delay of 2 control steps `recurrent` has 0.42 where late actions are skipped, and 0.98 "
        "where they are executed",
        page="real_time.md",
    ),
    Field(
        name="delay",
        words="delay",
        kind="setting",
        paths=("chunking.delay", "chunking.delay_steps"),
        effect="`recurrent` has 0.88 without a delay, and 0.42 at one of 2 control steps, with late actions "
        "skipped",
        page="real_time.md",
    ),
    Field(
        name="success_rule",
        words="success rule",
        kind="setting",
        paths=("env.strict_choice", "stop_at_success"),
        effect="where a wrong choice costs nothing, an arm that touches one candidate after another wins",
        page="audit.md",
    ),
    Field(
        name="world",
        words="changes of the task",
        kind="setting",
        paths=("env", "appearance", "cue_view", "memory_change", "reset_policy_at_step"),
        effect="without its cue, `memory_color3` falls from 1.00 to 0.31",
        page="results.md",
    ),
    Field(
        name="simulator",
        words="simulator",
        kind="setting",
        paths=("simulator", "sim_backend"),
        effect="the fake simulator has no physics; the GPU simulator was not compared with the CPU's",
    ),
    Field(
        name="rendering",
        words="rendering",
        kind="setting",
        paths=("render",),
        effect="no difference was found between the two meshes of the wrist camera: trained with the "
        "simplified one, `context` has 0.84 with it and 0.82 with the shipped one on RememberColor3; GPU "
        "renderers were not compared",
        page="passport.md",
    ),
    Field(
        name="seen_seeds",
        words="seeds known from training",
        kind="setting",
        effect="no difference was found here: on the seeds of their demonstrations `context` has 0.96 and "
        "`gtrxl` 0.88 on RememberColor3, on others 0.84 and 0.92; GMP's authors write that success at "
        "their demonstrations' seed is higher",
        page="passport.md",
    ),
    Field(
        name="simulator_versions",
        words="simulator versions",
        kind="environment",
        paths=("packages.mani_skill", "packages.sapien", "packages.gymnasium", "device.simulator"),
    ),
    Field(name="renderer", words="renderer", kind="environment", paths=("device", "mesa", "nvidia_driver")),
    Field(name="software", words="software", kind="environment", paths=("vla_eval", "packages", "python")),
    Field(name="machine", words="machine", kind="environment", paths=("",)),
    Field(name="weights", words="weights", kind="evidence"),
    Field(name="training", words="models", kind="evidence"),
    Field(name="demonstrations", words="seeds of demonstrations", kind="evidence"),
    Field(name="seeds", words="seeds", kind="evidence"),
    Field(name="episodes", words="episodes", kind="evidence"),
    Field(name="runs", words="runs", kind="evidence"),
)

BY_NAME: Mapping[str, Field] = MappingProxyType({field.name: field for field in FIELDS})
SETTINGS = tuple(field for field in FIELDS if field.kind == "setting")


def owner_of(path: str, kind: Kind) -> Field | None:
    """Return the field that a leaf of a configuration, or of an environment, belongs to; None of none."""
    owners = [
        (len(own), field)
        for field in FIELDS
        if field.kind == kind
        for own in field.paths
        if not own or path == own or path.startswith(f"{own}.")
    ]
    return max(owners, key=lambda one: one[0])[1] if owners else None


def setting_sections() -> tuple[str, ...]:
    """Return the fields of a configuration that hold settings, in the order of the table."""
    return tuple(dict.fromkeys(path.partition(".")[0] for field in SETTINGS for path in field.paths))
