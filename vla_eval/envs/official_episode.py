"""One official episode: its phases, its status for the record, its true state for scripted controls."""

from dataclasses import replace
from typing import Any, NamedTuple  # ManiSkill and the package are untyped: environments are Any here

import numpy as np

from vla_eval.envs.official_state import Choices, first_positions_m, read_bodies, read_candidates
from vla_eval.task_state import Phase, PrivilegedState, TaskStatus
from vla_eval.tasks.objects.bodies import to_vector, yaw_rad
from vla_eval.tasks.objects.layout import places_from_right
from vla_eval.tasks.spec import TaskSpec


class Waiting(NamedTuple):
    """The steps of an episode before the choice, as the environment has drawn them."""

    cue_steps: int
    delay_steps: int


def waiting_of(env: Any) -> Waiting:
    """Return the steps of cue and delay: drawn per episode in the 90 tasks, else constants."""
    if hasattr(env, "cue_steps_per_env"):
        delay = env.empty_steps_per_env if hasattr(env, "empty_steps_per_env") else [0]
        return Waiting(int(env.cue_steps_per_env[0]), int(delay[0]))
    if hasattr(env, "TIME_OFFSET"):
        return Waiting(int(env.TIME_OFFSET), int(getattr(env, "DELTA_TIME", 0)))
    return Waiting(int(env.STEP_DURATION), int(env.EMPTY_DURATION))


class OfficialEpisode:
    """A running episode at the step that was noted last.

    Attributes:
        phase: the phase; what happens between cue and choice is a delay, also where mugs are shuffled.
        candidates: where they are, and which is right; None for a task without.
    """

    def __init__(self, row: TaskSpec, env: Any) -> None:
        """Begin with the state after a reset."""
        self._row, self._env = row, env
        self.phase: Phase = self._phase(0)
        self.candidates = read_candidates(row, env, revealed=False)
        self._first = first_positions_m(row, env, self.candidates)
        self._choices = Choices(row, env, self._first)

    def note(self, step: int) -> None:
        """Look at the environment, which has been evaluated after so many control steps."""
        self.phase = self._phase(step)
        revealed = self.phase == "response"
        self.candidates = read_candidates(self._row, self._env, revealed=revealed)
        if self.candidates is not None and revealed:
            self._choices.note(self.candidates)

    def _phase(self, step: int) -> Phase:
        if self._row.phase_source == "none" and not self._row.has_candidates:
            return "response"
        waiting = waiting_of(self._env)
        if step < waiting.cue_steps:
            return "cue"
        return "delay" if step < sum(waiting) else "response"

    def status(self, *, success: bool) -> TaskStatus:
        """Return what the record says of this step."""
        said = TaskStatus(
            phase=None if self._row.phase_source == "none" else self.phase,
            success=success,
        )
        if self.candidates is None:
            return said
        target, chosen = self.candidates.target, tuple(self._choices.chosen)
        return replace(
            said,
            target=target,
            n_candidates=len(self.candidates.positions_m),
            first_choice=chosen[0] if chosen else None,
            n_wrong_choices=len(set(chosen) - {target}),
            right_first_choices=(target,),
            chance_success=1 / len(self.candidates.positions_m),
            candidate_places=places_from_right(self._first[:, :2]),
            right_candidates=(target,),
            touched_candidates=chosen,
        )

    def true_state(self) -> PrivilegedState | None:
        """Return what scripted controls are given; None for a task that has none."""
        row, env, candidates = self._row, self._env, self.candidates
        if row.true_state == "none":
            return None
        right = () if candidates is None else (candidates.target,)
        # The imposter is what the cue leaves out.
        is_shown = self.phase == "cue" and "/FindImposter" not in row.id
        tcp = env.agent.tcp
        return PrivilegedState(
            phase=self.phase,
            response_step=sum(waiting_of(env)) if row.has_candidates else 0,
            tcp_position_m=to_vector(tcp.pose.p[0]),
            tcp_velocity_m_s=to_vector(tcp.linear_velocity[0]),
            gripper_width_m=float(env.agent.robot.get_qpos()[0, -2:].sum()),
            candidate_positions_m=np.zeros((0, 3)) if candidates is None else candidates.positions_m,
            target=None if candidates is None else candidates.target,
            right_candidates=right,
            shown_candidates=right if is_shown else (),
            touched_candidates=tuple(self._choices.chosen),
            bodies=read_bodies(row, env, candidates, self._first),
            tcp_yaw_rad=float(yaw_rad(tcp.pose.q)[0]),
        )
