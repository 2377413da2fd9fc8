"""Which demonstrations are recorded on an arm: resolved once, at the door; and which trial comes next."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal  # plain data

from vla_eval.config.files import digest_of
from vla_eval.config.real_robot import RobotSettings
from vla_eval.real.plan import demonstration_trials
from vla_eval.storage.provenance import collect_environment
from vla_eval.storage.run_file import RunDescription
from vla_eval.strict.bounds import MAX_EPISODES, check_seeds, require
from vla_eval.tasks.real_stages import COLORS, Stage, Trial

DATA_FOLDER = Path("data")

Keep = Literal["successes", "all"]


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Which demonstrations are recorded, and how the arm is driven."""

    robot: RobotSettings  # in the control mode `motors`
    leader: str  # what leads the arm: LeRobot's type of a teleoperator, or `scripted`
    stages: tuple[Stage, ...]
    episodes: int  # per stage and colour
    seed: int  # of the plan
    keep: Keep = "successes"
    named_out: Path | None = None  # None: a folder in data/

    def __post_init__(self) -> None:
        """Refuse what cannot be recorded."""
        n, most = self.n_episodes, MAX_EPISODES
        require(self.episodes >= 1, "--episodes", str(self.episodes), "1 or more")
        require(n <= most, "the plan", f"{n} episodes", f"at most {most}")
        check_seeds(self.seed, name="--plan-seed")
        hz = self.robot.control_hz
        require(hz == int(hz), "control_hz", f"{hz:g}", "a whole number: the frames per second of a dataset")

    @property
    def n_episodes(self) -> int:
        """Of all stages."""
        return self.episodes * len(self.stages) * len(COLORS)

    def task(self, stage: Stage) -> str:
        """Return the id of a stage, which its dataset is called: its twin's on the simulated arm."""
        return stage.twin_id if self.robot.is_simulated else stage.real_id

    @property
    def out(self) -> Path:
        """The folder of the datasets."""
        return self.named_out or DATA_FOLDER / f"real-{digest_of(self._config)[:8]}"

    @property
    def _config(self) -> dict[str, Any]:
        return {
            "tasks": [self.task(stage) for stage in self.stages],
            "plan_seed": self.seed,
            "keep": self.keep,
            "robot": self.robot.content,
            "leader": self.leader,
            "teleop": self.robot.teleop_content,
        }

    def describe(self, *, command: str) -> RunDescription:
        """Return the recording's description; with fewer or more episodes it is the same."""
        return RunDescription(
            name="real",
            config=self._config,
            recipes={},
            environment=collect_environment(),
            options={"episodes": self.episodes},
            command=command,
        )

    def chosen(self, kept: Mapping[str, set[int]], tried: set[int]) -> tuple[list[Trial], Trial | None]:
        """Return the trials whose episodes are used, and the next one to record; None: all are there.

        Args:
            kept: name of a stage -> numbers of the trials whose episodes are kept; others are finished.
            tried: numbers of those whose episodes were discarded.
        """
        used: list[Trial] = []
        missing = {(name, color): self.episodes for name in kept for color in range(len(COLORS))}
        for trial in demonstration_trials(self.stages, seed=self.seed):
            if not any(missing.values()):
                break
            row = (trial.stage.name, trial.color)
            if not missing.get(row) or trial.number in tried:
                continue
            if trial.number not in kept[trial.stage.name]:
                return used, trial
            used.append(trial)
            missing[row] -= 1
        return used, None
