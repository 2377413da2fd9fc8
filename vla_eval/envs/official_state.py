"""The true state of an official episode: for records, what was chosen; for scripted controls, all of it.

Read from attributes of the official classes, which are named here in tables, so that this file knows how the
package calls things and nothing else does. A learned policy is given none of it.

Source: the classes of `mikasa_robo_suite/vla/memory_envs`, wheel mikasa-robo-suite 1.0.0.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple  # ManiSkill and the package are untyped: environments, actors are Any here

import numpy as np
from numpy.typing import NDArray

from vla_eval.envs.true_states import PARKED_ABOVE_M
from vla_eval.errors import SpecMismatchError
from vla_eval.task_state import BodyState
from vla_eval.tasks.objects.bodies import to_array, yaw_rad
from vla_eval.tasks.spec import TaskSpec

Vector = NDArray[np.float64]

STATIC_RAD_S = 0.2  # at which the official tasks take the arm to be at rest
CHOSEN_M = 0.02  # by which a mug must have been pushed to count as chosen, as in this package's ShellGamePush
PUSH_FORWARDS_M = 0.1  # from the ball to the goal of ShellGamePush


class _Items(NamedTuple):
    """Names of the attributes with the items, the right one, and the places at which they will lie."""

    actors: str
    target: str
    places: str


_ITEMS = {
    "RememberColor": _Items("cubes", "true_color_indices", "initial_poses"),
    "RememberShape": _Items("shape_actors", "true_shape_indices", "initial_poses"),
    "RememberShapeAndColor": _Items("shape_actors", "true_shape_indices", "initial_poses"),
    "FindImposterColor": _Items("cubes", "imposter_key", "_manip_raw_poses"),
    "FindImposterShape": _Items("shape_actors", "imposter_key", "_manip_raw_poses"),
    "FindImposterShapeAndColor": _Items("shape_actors", "true_shape_indices", "_manip_raw_poses"),
}
_MUGS = ("mug_left", "mug_center", "mug_right")


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """The objects among which one has to be chosen."""

    positions_m: Vector  # (N, 3) where each is or, before the choice, will be; world frame
    target: int  # index of the right one


def read_candidates(row: TaskSpec, env: Any, *, revealed: bool) -> Candidates | None:
    """Return the candidates of an official environment, evaluated at this step; None for a task without."""
    if row.true_state == "items":
        names = _ITEMS[_family(row)]
        actors, places = _own(env, names.actors), _own(env, names.places)
        keys = list(actors)
        now = [actors[key].pose.p[0] if revealed else places[key].reshape(-1)[:3] for key in keys]
        return Candidates(positions_m=_stack(now), target=keys.index(int(_own(env, names.target)[0])))
    if row.true_state == "mugs":
        target = "target_color" if "ColorLamp" in row.id else "cup_with_ball_number"
        return Candidates(positions_m=_mug_positions_m(row, env), target=int(_own(env, target)[0]))
    return None


def read_bodies(
    row: TaskSpec, env: Any, candidates: Candidates | None, first: Vector
) -> dict[str, BodyState]:
    """Return what the family's expert reads, by its names; `first` (N, 3) is where peg or mugs were."""
    if row.true_state == "ball":
        goal = {"goal": _place(_own(env, "goal_region"))} if hasattr(env, "goal_region") else {}
        return {"ball": _moving(_own(env, "ball")), **goal}
    if row.true_state == "peg":
        yaw = float(_own(env, "initial_rotations")[0]) + float(_own(env, "target_angle")[0])
        return {"peg": _moving(_own(env, "peg")), "goal": _at(first[0], yaw)}
    if row.true_state == "cube":
        return {
            "cube": _moving(_own(env, "cube")),
            "goal": _place(_own(env, "goal_region")),
            "first_place": _place(_own(env, "initial_region")),
        }
    if candidates is None or not _pushes(row):
        return {}
    goals_m = first + np.array([PUSH_FORWARDS_M, 0, 0])
    return {
        **{f"mug_{index}": _at(place) for index, place in enumerate(candidates.positions_m)},
        **{f"goal_{index}": _at(place) for index, place in enumerate(goals_m)},
    }


def first_positions_m(row: TaskSpec, env: Any, candidates: Candidates | None) -> Vector:
    """Return (N, 3) where the candidates, or the peg, are at the start of an episode."""
    if candidates is not None:
        return candidates.positions_m
    return _stack([_own(env, "peg").pose.p[0]]) if row.true_state == "peg" else np.zeros((0, 3))


class Choices:
    """Which candidates of an episode have been chosen so far, in the order of their first choice.

    An item or a mug is chosen when, after the reveal, it is the nearest one to the tool centre point, within
    the task's own threshold, and the arm is at rest; in ShellGamePush, when it has been pushed. These are the
    rules of this package's tasks: the official tasks have none.
    """

    def __init__(self, row: TaskSpec, env: Any, first: Vector) -> None:
        self._pushes, self._env, self._first = _pushes(row), env, first
        self.chosen: list[int] = []

    def note(self, candidates: Candidates) -> None:
        """Look at one step after the reveal."""
        for index in self._found(candidates):
            if index not in self.chosen:
                self.chosen.append(index)

    def _found(self, candidates: Candidates) -> Sequence[int]:
        if self._pushes:
            pushed_m = np.linalg.norm((candidates.positions_m - self._first)[:, :2], axis=1)
            return [int(i) for i in np.argsort(-pushed_m, kind="stable") if pushed_m[i] >= CHOSEN_M]
        tcp_m = to_vector(self._env.agent.tcp.pose.p[0])
        away_m = np.linalg.norm(candidates.positions_m - tcp_m, axis=1)
        nearest = int(away_m.argmin())
        is_near = away_m[nearest] <= _own(self._env, "GOAL_THRESH")
        return [nearest] if is_near and bool(self._env.agent.is_static(STATIC_RAD_S)[0]) else []


def _mug_positions_m(row: TaskSpec, env: Any) -> Vector:
    """Return (3, 3): before they are revealed, the mugs are shown above their places."""
    family = _family(row)
    if family == "ShellGameColorLampTouch":
        return to_vector(_own(env, "slot_positions")[0])
    if family.startswith("ShellGameShuffle"):
        last = int(_own(env, "num_swaps_per_env")[0])
        slots = [int(slot) for slot in _own(env, "slot_of_mug")[0, last]]
        return to_vector(_own(env, "slot_positions")[0])[slots]
    positions_m = _stack([_own(env, name).pose.p[0] for name in _MUGS])
    positions_m[positions_m[:, 2] > PARKED_ABOVE_M, 2] -= _own(env, "HEIGHT_OFFSET")
    return positions_m


def _family(row: TaskSpec) -> str:
    """Return `RememberColor` of `mikasa_vla/RememberColor3-Long-VLA-v0`."""
    found = re.match(r"[A-Za-z]+", row.id.rpartition("/")[2])
    assert found is not None  # ids begin with a name
    return found[0]


def _pushes(row: TaskSpec) -> bool:
    return _family(row) == "ShellGamePush"


def _own(env: Any, name: str) -> Any:
    try:
        return getattr(env, name)
    except AttributeError as exc:
        raise SpecMismatchError(
            f"{type(env).__name__}: expected the attribute '{name}' of mikasa-robo-suite 1.0.0, found none. "
            "Is another version installed? `make suite90` installs 1.0.0."
        ) from exc


def _stack(positions: Sequence[Any]) -> Vector:
    return np.stack([to_vector(position) for position in positions])


def _moving(actor: Any) -> BodyState:
    pose = actor.pose
    return BodyState(
        position_m=to_vector(pose.p[0]),
        velocity_m_s=to_vector(actor.linear_velocity[0]),
        yaw_rad=float(yaw_rad(to_array(pose.q))[0]),
    )


def _place(actor: Any) -> BodyState:
    return _at(to_vector(actor.pose.p[0]))


def _at(position_m: Vector, yaw: float = 0.0) -> BodyState:
    return BodyState(position_m=position_m, velocity_m_s=np.zeros(3), yaw_rad=yaw)


def to_vector(tensor: Any) -> NDArray[np.float64]:  # Any: ManiSkill is untyped
    """Return a tensor as new float64 numbers."""
    return to_array(tensor).astype(np.float64)
