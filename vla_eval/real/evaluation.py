"""What a person asks to be evaluated on an arm: resolved once, at the door."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any  # plain data

from vla_eval.checkpoints.notes import checkpoint_hashes, trained_control_mode
from vla_eval.chunking import ChunkingSettings
from vla_eval.config.files import digest_of
from vla_eval.config.real_robot import REAL_CONTROL_MODES, RobotSettings
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.recipe import bare_policy
from vla_eval.policies.registry import PRIVILEGED, check_adapter
from vla_eval.real.episodes import RUN
from vla_eval.real.plan import FIRST_DEMONSTRATION_BLOCK, PlannedEpisode, make_plan
from vla_eval.records import EpisodeKey
from vla_eval.rollout import RolloutSettings
from vla_eval.storage.provenance import collect_environment
from vla_eval.storage.run_folder import RunDescription
from vla_eval.storage.starting import RUNS_FOLDER
from vla_eval.strict.bounds import MAX_EPISODES, check_seeds, require
from vla_eval.tasks.real_stages import COLORS, Stage, stage_of

RANDOM = "random"  # adapter


@dataclass(frozen=True, kw_only=True)
class RealEvaluation:
    """An evaluation on an arm, as it will run."""

    robot: RobotSettings
    policies: tuple[PolicyEntry, ...]
    stages: tuple[Stage, ...]
    episodes: int  # per stage, colour and policy
    seed: int  # of the plan
    n_action_steps: int | None  # None: each policy's own
    named_out: Path | None = None  # None: the default run folder

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        n_episodes = self.episodes * len(self.stages) * len(COLORS) * len(self.policies)
        most = FIRST_DEMONSTRATION_BLOCK
        require(1 <= self.episodes <= most, "--episodes", str(self.episodes), f"from 1 to {most}")
        check_seeds(self.seed, name="--plan-seed")
        require(n_episodes <= MAX_EPISODES, "the plan", f"{n_episodes} episodes", f"at most {MAX_EPISODES}")
        for entry in self.policies:
            check_adapter(entry.value.adapter)
            if len(entry.recipes) > 1:
                raise RecipeError(
                    f"policies: {entry.name}: expected one checkpoint, found {len(entry.recipes)}. On an arm "
                    "each is a policy of its own: give them different names."
                )
            if entry.value.adapter == RANDOM and not self.robot.is_simulated:
                raise SpecMismatchError(
                    f"policy '{entry.name}' moves at random, which no real arm should. Rehearse it with "
                    "--robot simulated_so100."
                )
            if entry.value.adapter in PRIVILEGED and not self.robot.is_simulated:
                raise SpecMismatchError(
                    f"policy '{entry.name}' reads the true state of the world, which a real arm does not "
                    "tell. Rehearse it with --robot simulated_so100."
                )
        for stage in self.stages:
            for name in self.names:
                self.entry(name, stage)

    @property
    def names(self) -> tuple[str, ...]:
        """What records call the policies."""
        return tuple(dict.fromkeys(entry.name for entry in self.policies))

    def entry(self, name: str, stage: Stage) -> PolicyEntry:
        """Return the policy of this name for a stage.

        Raises:
            RecipeError: there is none, or there are several.
        """
        own = [
            one
            for one in self.policies
            if one.name == name and (one.task is None or stage_of(one.task) == stage)
        ]
        if len(own) != 1:
            raise RecipeError(
                f"policies: expected one '{name}' for {stage.name}, found {len(own)}. Name one checkpoint "
                f"for all stages, or one for each: {name}:{stage.twin_id}=DIR …"
            )
        return own[0]

    def settings(self, entry: PolicyEntry) -> RobotSettings:
        """Return how a policy drives the arm: by the actions of its training, else as the arm's file says.

        Raises:
            RecipeError: they are angles of the arm's model, and the zeros of its joints are not known.
        """
        mode = trained_control_mode(entry.value.adapter, entry.recipes[0].value.args)
        mode = mode if entry.server is None else entry.server.control_mode
        known = next((one for one in REAL_CONTROL_MODES if one == mode), self.robot.control_mode)
        return dataclasses.replace(self.robot, control_mode=known)

    @cached_property
    def plan(self) -> tuple[PlannedEpisode, ...]:
        """The episodes, in their order."""
        return make_plan(self.names, self.stages, episodes=self.episodes, seed=self.seed)

    def task(self, stage: Stage) -> str:
        """Return what records call a stage: its twin's id on the simulated arm."""
        return stage.twin_id if self.robot.is_simulated else stage.real_id

    def key(self, planned: PlannedEpisode) -> EpisodeKey:
        """Return the identity of an episode."""
        stage = planned.trial.stage
        n_action_steps = self.rollout(self.entry(planned.policy, stage)).chunking.n_action_steps
        return EpisodeKey(self.task(stage), planned.policy, n_action_steps, RUN, planned.trial.seed)

    def rollout(self, entry: PolicyEntry) -> RolloutSettings:
        """Return how an episode of a policy runs: it ends when the right cube is picked."""
        n_action_steps = self.n_action_steps or entry.value.default_n_action_steps
        return RolloutSettings(chunking=ChunkingSettings().at(n_action_steps), stop_at_success=True)

    @property
    def out(self) -> Path:
        """The run folder."""
        return self.named_out or RUNS_FOLDER / f"real-{digest_of(self._config)[:8]}"

    @property
    def _config(self) -> dict[str, Any]:
        tasks = [self.task(stage) for stage in self.stages]
        return {
            "tasks": tasks,
            "task_versions": dict.fromkeys(tasks, 1),
            "policies": [bare_policy(text) for entry in self.policies for text in entry.texts],
            "policy_names": list(self.names),
            "n_action_steps": None if self.n_action_steps is None else [self.n_action_steps],
            "episodes": self.episodes * len(COLORS),
            "runs": 1,
            "seed_start": 0,
            "stop_at_success": True,
            "env": {"robot": self.robot.type},
            "real": {
                "plan_seed": self.seed,
                "policies": list(self.names),
                "stages": [stage.name for stage in self.stages],
                "robot": self.robot.content,
            },
        }

    def describe(self, *, command: str, options: Mapping[str, Any]) -> RunDescription:
        """Return the run's description, for `run.json`; `options` move no result."""
        recipes = {}
        for entry in self.policies:
            recipes[f"policies/{entry.part(0)}"] = entry.recipes[0].sha256
            recipes |= checkpoint_hashes(
                entry.value.adapter, entry.recipes[0].value.args, policy=entry.part(0)
            )
        servers = {entry.name: entry.server.identity() for entry in self.policies if entry.server is not None}
        return RunDescription(
            name="real",
            config=self._config,
            recipes=recipes,
            environment=collect_environment(),
            options=options,
            command=command,
            servers=servers,
        )
