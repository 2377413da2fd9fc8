"""Controls for tasks with candidates: go to the right one or ones, to any, or to one after another."""

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.base import ScriptedPolicy, hold_rows
from vla_eval.task_state import PrivilegedState

STATIC_RAD_S = 0.2

Mode = Literal["oracle", "cue_blind", "tour", "cue_reader"]


class CandidateExpert(Protocol):
    """Brings the arm to one of several candidates."""

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether all is done with this candidate that is to be done, but for coming to rest."""

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7)."""


class VisitExpert(Protocol):
    """Brings the arm to several candidates, one after another."""

    def plan_visits(
        self, state: PrivilegedState, wanted: Sequence[int], n_actions: int, *, in_order: bool
    ) -> NDArray[np.float32]:
        """Return (n_actions, 7) that touch the wanted candidates, in their order or in any."""


class _CandidateArm[Expert](ScriptedPolicy):
    """Holds until the choice can be made. A blind arm draws its order before it sees anything."""

    privileged = True

    def __init__(self, context: PolicyContext, expert: Expert, mode: Mode) -> None:
        super().__init__(context)
        self._expert = expert
        self._mode = mode
        self._drawn: dict[int, list[int]] = {}
        self._in_view: dict[int, set[int]] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Decide, without looking, where a blind arm goes (first)."""
        super().reset(episodes)
        for episode in episodes:
            order = self._rng[episode.slot].permutation(self._context.n_candidates)
            self._drawn[episode.slot] = [int(i) for i in order]
            self._in_view[episode.slot] = set()

    def act(self, window: ObservationWindow) -> ActionChunk:
        state = self.privileged_state(window)
        self._in_view[window.slot].update(state.shown_candidates)
        if state.phase != "response":
            return ActionChunk(actions=hold_rows(state.gripper_width_m, self._n_actions, self._n_dims))
        return ActionChunk(actions=self._go(window, state))

    def _go(self, window: ObservationWindow, state: PrivilegedState) -> NDArray[np.float32]:
        """Return (n_actions, 7): the way to the candidate or candidates."""
        raise NotImplementedError

    def _knows(self, slot: int, candidate: int) -> bool:
        return self._mode == "oracle" or (self._mode == "cue_reader" and candidate in self._in_view[slot])


class ChoicePolicy(_CandidateArm[CandidateExpert]):
    """Goes to candidates: the right one, one drawn uniformly, or one after another."""

    states = ("qvel",)

    def _go(self, window: ObservationWindow, state: PrivilegedState) -> NDArray[np.float32]:
        return self._expert.plan(state, self._candidate(window, state), self._n_actions)

    def _candidate(self, window: ObservationWindow, state: PrivilegedState) -> int:
        assert state.target is not None  # one candidate is right in the tasks of this policy
        if self._knows(window.slot, state.target):
            return state.target
        order = self._drawn[window.slot]
        if self._mode == "tour" and len(order) > 1 and self._touches(window, state, order[0]):
            here = state.candidate_positions_m[order.pop(0)]
            order.sort(key=lambda i: float(np.linalg.norm(state.candidate_positions_m[i] - here)))
        return order[0]

    def _touches(self, window: ObservationWindow, state: PrivilegedState, candidate: int) -> bool:
        qvel = window.last.state["qvel"][list(self.arm.arm_joints)]
        at_rest = bool(np.abs(qvel).max() <= STATIC_RAD_S)
        return at_rest and self._expert.is_done(state, candidate)


class VisitPolicy(_CandidateArm[VisitExpert]):
    """Goes to several candidates: the right ones, as many drawn uniformly where it knows none, or all."""

    def _go(self, window: ObservationWindow, state: PrivilegedState) -> NDArray[np.float32]:
        wanted, in_order = self._itinerary(window.slot, state)
        left = [candidate for candidate in wanted if candidate not in state.touched_candidates]
        return self._expert.plan_visits(state, left, self._n_actions, in_order=in_order)

    def _itinerary(self, slot: int, state: PrivilegedState) -> tuple[list[int], bool]:
        """Return the candidates to touch, and whether in this order."""
        drawn = self._drawn[slot]
        if self._mode == "tour":
            begun = bool(state.touched_candidates)
            return (drawn, False) if begun else (drawn[:1], True)
        right = state.right_candidates
        known = [candidate for candidate in right if self._knows(slot, candidate)]
        guesses = iter([candidate for candidate in drawn if candidate not in known])
        return [one if one in known else next(guesses) for one in right], state.in_order
