"""The arguments of a task: which it takes, whether they are possible, and what it then offers to a policy.

No simulator is started: the task's row and the source of its class say it all.
"""

import ast
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

from vla_eval.config.environment import WristMesh
from vla_eval.control_modes import CONTROL_MODE
from vla_eval.errors import RecipeError, TaskArgumentError, check_names
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots.find import ROBOT, ROBOT_UIDS, action_of, control_mode_of, naming, robot_of, robots
from vla_eval.robots.rows import PANDA
from vla_eval.specs import EnvSpec
from vla_eval.strict.decoding import check_value
from vla_eval.tasks.arm.arms import WRIST_MESH_ROBOTS
from vla_eval.tasks.catalog import TASKS, family_of
from vla_eval.tasks.interface import CONTROL_HZ, IMAGE_SIZE, StepRange, cameras, states, step_range
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.free_places import free_places_m, free_things, used_areas
from vla_eval.tasks.objects.item_names import item_names
from vla_eval.tasks.objects.limits import LIMITED, check_together, n_swaps
from vla_eval.tasks.objects.mesh_folder import MESHES
from vla_eval.tasks.source import class_constant, task_arguments
from vla_eval.tasks.spec import TaskSpec, total_cue_steps

if TYPE_CHECKING:
    from vla_eval.tasks.objects.meshes import MeshSet

HORIZON = "horizon_steps"
OF_EVERY_TASK: Mapping[str, str] = {HORIZON: "SomeSteps", ROBOT: "str", ROBOT_UIDS: "str"}
"""Arguments that no class takes -> their annotation."""
OWN = "vla_eval.tasks."
"""Classes of other packages may count otherwise which other cues and free places there are."""
CHOICE_ARGUMENTS = ("strict_choice", "show_cue", "cue_after_steps")
"""Arguments that only tasks with candidates have."""
ANNOTATIONS: Mapping[str, Any] = {  # Any: type annotations
    **{"int": int, "float": float, "bool": bool, "str": str},
    **{"float | None": float | None, "str | None": str | None},
    **{"StepRange": StepRange, "Sequence[float]": Sequence[float]},
    **LIMITED,
    **{f"{name} | None": kind | None for name, kind in LIMITED.items()},
}
"""Annotation in the source of a task -> the type; arguments with another one are checked by the class."""


def check_arguments(spec: TaskSpec, given: Mapping[str, object]) -> None:
    """Check all that can be wrong with a task's arguments; a class of another package may refuse more.

    Raises:
        TaskArgumentError: a required argument of a family is missing; or an argument needs candidates,
            and this task has none; or a value is of another type or impossible; or the episode ends before
            the choice.
        UnknownNameError: there is no such argument, arm or control mode.
    """
    _check_open(spec, given)
    of_choices = [f"env.{name}" for name in CHOICE_ARGUMENTS if name in given]
    if of_choices and spec.candidates is None:
        raise TaskArgumentError(
            f"{', '.join(of_choices)}: {spec.id}: there are no candidates to choose among. Use this task "
            f"without it, in a run of its own."
        )
    action_of(given)
    if spec.is_official:
        return
    _check_names_and_types(spec, given)
    n_candidates = spec.n_candidates(given)
    _check_robot(spec, given)
    try:
        check_together(**_with_usual(spec, given))
    except TaskArgumentError as exc:
        raise TaskArgumentError(f"{spec.id}: {exc}") from exc
    found = meshes_of(given)
    if found is not None:
        found.candidates(n_candidates)
    horizon_steps(spec, longest_wait_steps(spec, given), given.get(HORIZON))


def _check_open(spec: TaskSpec, given: Mapping[str, object]) -> None:
    """Raise unless a family is given all that makes a task of it."""
    missing = [name for name in spec.open_arguments if name not in given]
    if not missing:
        return
    rows = TASKS.values()
    known = [row.id for row in rows if row.id.startswith(spec.id) and row.entry_point == spec.entry_point]
    wanted = " ".join(f"--set env.{name}=…" for name in missing)
    raise TaskArgumentError(
        f"{spec.id} is a family of tasks: {', '.join(missing)} must say which one. Add {wanted}, or name "
        f"one of {', '.join(known)}."
    )


def _check_names_and_types(spec: TaskSpec, given: Mapping[str, object]) -> None:
    arguments = {argument.name: argument.annotation for argument in task_arguments(spec.entry_point)}
    if not arguments:  # a class of another package, made in a way that cannot be read
        return
    annotations = {**arguments, **OF_EVERY_TASK}
    check_names("argument", given, annotations, where=f"env of {spec.id}")
    for name, value in given.items():
        check_argument(_type_of(annotations[name]), value, name=name, task=spec.id)


def _type_of(annotation: str) -> Any:  # Any: a type annotation
    if annotation.startswith("Literal["):
        return Literal[ast.literal_eval(annotation.removeprefix("Literal[").removesuffix("]"))]
    return ANNOTATIONS.get(annotation, Any)


def _with_usual(spec: TaskSpec, given: Mapping[str, object]) -> dict[str, Any]:  # Any: plain data
    """Return all arguments of a task that are plain data, and what follows from them."""
    found: dict[str, Any] = {}
    for argument in task_arguments(spec.entry_point):
        with suppress(ValueError):  # a calculation: the class alone knows what it gives
            found[argument.name] = ast.literal_eval(argument.default)
    found |= {**spec.kwargs, **given, CONTROL_MODE: control_mode_of(given)}
    if spec.has_candidates:
        found["n_items"] = spec.n_candidates(given)
    if spec.entry_point.startswith(OWN):
        found["n_swaps"] = n_swaps(**found)
        if found["clutter"]:
            places_m = free_places_m(used_areas(**found), base_m=robot_of(given).base_m)
            of_task = given.get(MESHES) is None
            items = item_names(family_of(spec), spec.n_candidates(given)) if of_task else ()
            found |= {"n_free_places": len(places_m), "n_free_things": len(free_things(items))}
    if "delay_steps" in found:
        found["least_delay"], _ = step_range("delay_steps", found["delay_steps"])
    return {**found, "one_by_one": spec.shows_one_by_one}


def meshes_of(given: Mapping[str, Any]) -> "MeshSet | None":  # Any: plain data
    """Return the meshes of the folder that arguments name, checked; None if they name none.

    Raises:
        TaskArgumentError: the folder is not there, or one of its meshes cannot be used.
    """
    if given.get(MESHES) is None:
        return None
    # Here and not above: what reads meshes takes long to import, and few tasks have any.
    from vla_eval.tasks.objects.meshes import read_meshes

    usual: dict[str, Any] = {"mesh_scale": 1.0, "mesh_holes": False}
    arguments = {name: given.get(name, value) for name, value in {MESHES: None, **usual}.items()}
    for name, kind in ((MESHES, str), ("mesh_scale", limits.MeshScale), ("mesh_holes", bool)):
        check_argument(kind, arguments[name], name=name, task="env")
    return read_meshes(arguments[MESHES], scale=arguments["mesh_scale"], allow_holes=arguments["mesh_holes"])


def pinned(given: Mapping[str, Any], tasks: Sequence[TaskSpec]) -> dict[str, Any]:  # Any: plain data
    """Return arguments in which a folder of meshes, if any, has its whole path and the digest of its files.

    Raises:
        TaskArgumentError: it is not there, or one of its meshes cannot be used.
        UnknownNameError: one of the tasks takes none.
    """
    for spec in tasks if MESHES in given else ():
        if not (spec.is_official or spec.is_base):
            _check_names_and_types(spec, given)
    found = meshes_of(given)
    return dict(given) if found is None else {**given, MESHES: found.pinned}


def _check_robot(spec: TaskSpec, given: Mapping[str, object]) -> None:
    reason = robot_of(given).not_solved.get(family_of(spec))
    if reason is not None:
        solving = [arm.name for arm in robots().values() if family_of(spec) not in arm.not_solved]
        raise TaskArgumentError(
            f"{naming(given)}: this robot does not solve {spec.id}: {reason}. Robots that do: "
            f"{', '.join(solving)}."
        )
    robot_uid(given, wrist_mesh="shipped")


def robot_uid(given: Mapping[str, object], *, wrist_mesh: WristMesh) -> str:
    """Return ManiSkill's name of the requested robot: of the Panda that with the requested mesh.

    Raises:
        TaskArgumentError: the robot has no such mesh, or one was chosen twice.
        UnknownNameError: there is no such robot.
    """
    arm = robot_of(given)
    if arm is PANDA and ROBOT_UIDS not in given:
        return WRIST_MESH_ROBOTS[wrist_mesh]
    if wrist_mesh != "shipped" or arm is PANDA:
        raise TaskArgumentError(
            f"{naming(given)} with render.wrist_mesh={wrist_mesh!r}: the mesh belongs to the Panda, the "
            "default arm. Set only one of the two."
        )
    return arm.uids[0]


def longest_wait_steps(spec: TaskSpec, given: Mapping[str, object]) -> int:
    """Return the most steps that cue and delay can take together with these arguments.

    Raises:
        TaskArgumentError: one of them is not a number of steps, nor a pair of them.
    """
    arguments = _with_usual(spec, given)

    def most(name: str, *, otherwise: int = 0) -> int:
        return step_range(name, arguments.get(name, otherwise))[1]

    n_in_turn = most("n_shown", otherwise=1) if spec.shows_one_by_one else 1
    cue_steps = total_cue_steps(most("cue_steps"), n_in_turn, most("gap_steps"))
    return most("cue_after_steps") + cue_steps + most("delay_steps")


def horizon_steps(spec: TaskSpec, longest_wait: int, wanted: object = None) -> int:
    """Return the length of an episode: as requested, or as in the row.

    Raises:
        TaskArgumentError: too short for a step of the choice.
    """
    horizon = wanted if isinstance(wanted, int) else spec.default_horizon_steps(longest_wait)
    if longest_wait >= horizon:
        raise TaskArgumentError(
            f"{spec.id}: cue_steps and delay_steps can be {longest_wait} together, but the episode ends "
            f"after horizon_steps={horizon}: no step is left for the choice. Increase horizon_steps or "
            "shorten the phases."
        )
    return horizon


def offered_by(spec: TaskSpec, given: Mapping[str, object]) -> EnvSpec:
    """Return what a task offers with these arguments, without making its environment.

    Raises:
        TaskArgumentError: the arguments are impossible.
        UnknownNameError: there is no such control mode or robot.
    """
    size_px = given.get(IMAGE_SIZE)
    arm = robot_of(given)
    prompt_dims = None if spec.is_official else class_constant(spec.entry_point, "PROMPT_DIMS")
    wait = 0 if spec.is_official else longest_wait_steps(spec, given)
    return EnvSpec(
        task=spec.id,
        cameras=cameras(size_px if isinstance(size_px, int) else IMAGE_SIZE_PX),
        states=states(arm.joints, prompt_dims if isinstance(prompt_dims, tuple) else ()),
        action=action_of(given),
        horizon_steps=horizon_steps(spec, wait, given.get(HORIZON)),
        control_hz=CONTROL_HZ,
        robot=arm.name,
    )


def check_argument(hint: Any, value: object, *, name: str, task: str) -> None:  # Any: a type annotation
    """Raise `TaskArgumentError` unless an argument is of the type that the task declares for it."""
    try:
        if hint is StepRange:
            step_range(name, value)
            return
        limited = next((kind for kind in (hint, *get_args(hint)) if get_origin(kind) is Annotated), None)
        is_given = value is not None or hint is limited
        check_value(get_args(limited)[0] if limited and is_given else hint, value, path=name)
        if limited and is_given:
            limits.check(limited, **{name: value})
    except (RecipeError, TaskArgumentError) as exc:
        raise TaskArgumentError(f"{task}: {exc}") from exc
