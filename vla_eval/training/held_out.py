"""Evaluate checkpoints during training, on seeds that are used for nothing else.

It runs while the training waits, since both need the same device, and draws from none of its generators. A
training that was killed during one finishes it first and then resumes.
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vla_eval.checkpoints.files import MODEL_FOLDER, TrainingFacts, checkpoint_name
from vla_eval.checkpoints.trained_with import Asked, about_sentence, differences, refuse_differences
from vla_eval.config.dataset import EVALUATION_SEEDS
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import digest_of, to_data
from vla_eval.config.finetuning import FinetuneRecipe, HeldOutConfig
from vla_eval.config.prompts import instruction_for
from vla_eval.control_modes import CONTROL_MODE, MOTORS
from vla_eval.errors import RecipeError
from vla_eval.evaluation.evaluate import EvaluationObserver, evaluate
from vla_eval.evaluation.resolve import resolve
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import mean_return, wilson_interval
from vla_eval.robots.find import control_mode_of
from vla_eval.robots.rows import PANDA
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import env_spec
from vla_eval.training.run_folder import whole_checkpoints

if TYPE_CHECKING:  # it imports lerobot; a finished training is known without
    from vla_eval.data.opening import OpenDataset

EVALUATIONS_FOLDER = "evaluations"
METRIC_KEY = "held_out"
"""Of a line of metrics: which evaluation it is of."""
ID_DIGITS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """The evaluations of one training."""

    settings: HeldOutConfig
    task: str
    out: Path  # run folder of the training
    last_step: int  # its last step, whose checkpoint is evaluated in any case
    # takes one line of metrics
    on_metrics: Callable[[Mapping[str, float | str]], None] = lambda _line: None
    say: Callable[[str], None] = lambda _line: None
    # an evaluation ends early once it says yes, without a figure; `catch_up` resumes it
    is_stopping: Callable[[], bool] = lambda: False
    # warnings of earlier checkpoints' evaluations, without the checkpoint's name
    said: set[str] = field(default_factory=set)

    @property
    def identity(self) -> str:
        """A digest of the settings: evaluations with other settings have another."""
        settings = to_data(self.settings)
        del settings["workers"]  # moves no result
        return digest_of([settings, self.task])[:ID_DIGITS]

    def is_due(self, step: int) -> bool:
        """Whether the checkpoint of this step is evaluated."""
        return step % self.settings.every_steps == 0 or step == self.last_step

    def catch_up(self, done: Iterable[Mapping[str, object]]) -> None:
        """Evaluate the checkpoints without a result among these lines of metrics, until asked to stop."""
        for checkpoint in self.missing(done):
            if not self.is_stopping():
                self.evaluate(checkpoint)

    def missing(self, done: Iterable[Mapping[str, object]]) -> list[Path]:
        """Return the checkpoints that are there and have no result, given the lines of metrics."""
        evaluated = {line["step"] for line in done if line.get(METRIC_KEY) == self.identity}
        steps = {folder: int(folder.name) for folder in whole_checkpoints(self.out)}
        return [folder for folder, step in steps.items() if self.is_due(step) and step not in evaluated]

    def evaluate(self, checkpoint: Path) -> None:
        """Evaluate a checkpoint (`…/000100`) and report its figure; finished episodes are not run again."""
        folder = self.out / EVALUATIONS_FOLDER / f"{checkpoint.name}-{self.identity}"
        # Versions may change within a training of some days; the run folder notes it.
        stops = _UntilStopped(self.is_stopping, functools.partial(self._warn, checkpoint))
        resolved = resolve(self._config(checkpoint), out=folder)
        if evaluate(resolved, allow_environment_change=True, observer=stops).was_stopped:
            return
        records = read_run(folder).records
        ended = [record for record in records if record.error is None]
        n_errors = len(records) - len(ended)
        step = int(checkpoint.name)
        line: dict[str, float | str] = {
            "step": step,
            METRIC_KEY: self.identity,
            "n_episodes": len(ended),
            "n_errors": n_errors,
            **_figures(ended),
        }
        rate = _in_words(line) or "no episode came to its end"
        errors = f", {n_errors} errors: {folder}" if n_errors else ""
        self.say(f"step {step}/{self.last_step}  {self.task}, held-out seeds: {rate}{errors}")
        self.on_metrics(line)

    def _warn(self, checkpoint: Path, line: str) -> None:
        """Say what an evaluation warns of, once for all checkpoints."""
        name = checkpoint_name(checkpoint)
        told = line.replace(name, name.removesuffix(f"-{checkpoint.name}"))
        if told not in self.said:
            self.said.add(told)
            self.say(f"warning: {told}")

    def _config(self, checkpoint: Path) -> EvalConfig:
        settings = self.settings
        return EvalConfig(
            name="held-out",
            tasks=(self.task,),
            policies=(str(checkpoint.resolve() / MODEL_FOLDER),),
            n_action_steps=None if settings.n_action_steps is None else (settings.n_action_steps,),
            episodes=settings.episodes,
            seed_start=settings.seed_start,
            env=settings.env,
            simulator=settings.simulator,
            slots_per_worker=settings.slots_per_worker,
            inference="in_process",  # results of one training have to be comparable on any machine
            workers=settings.workers,
        )


def _figures(ended: Sequence[EpisodeRecord]) -> dict[str, float]:
    """Return the success rate, where the task has a rule for it, and the mean return, with intervals."""
    found: dict[str, float] = {}
    known = [record.success_once for record in ended if record.success_once is not None]
    interval = wilson_interval(sum(known), len(known))
    if interval is not None:
        found |= {
            "success_once": sum(known) / len(known),
            "success_low": interval.low,
            "success_high": interval.high,
        }
    returns = [record.episode_return for record in ended if record.episode_return is not None]
    if len(returns) > 1:
        mean, between = mean_return([returns])
        found |= {"mean_return": mean, "return_low": between.low, "return_high": between.high}
    return found


def _in_words(line: Mapping[str, float | str]) -> str:
    n = int(line["n_episodes"])
    if "success_once" in line:
        n_success = round(float(line["success_once"]) * n)
        low, high = (float(line[f"success_{end}"]) for end in ("low", "high"))
        return f"success {n_success}/{n} (95 % interval {low:.2f} to {high:.2f})"
    if "mean_return" in line:
        low, high = (float(line[f"return_{end}"]) for end in ("low", "high"))
        return f"return {float(line['mean_return']):.3g} (95 % interval {low:.3g} to {high:.3g})"
    return ""


class _UntilStopped(EvaluationObserver):
    """Stops an evaluation with the training that it is of, and passes on its warnings."""

    def __init__(self, is_stopping: Callable[[], bool], warn: Callable[[str], None]) -> None:
        self._is_stopping, self._warn = is_stopping, warn

    def on_warning(self, line: str) -> None:
        """Pass it on."""
        self._warn(line)

    def on_tick(self) -> bool:
        """Return whether to stop."""
        return self._is_stopping()


def check_held_out(settings: HeldOutConfig, recipe: FinetuneRecipe, dataset: "OpenDataset") -> str:
    """Return the task that is evaluated, if the seeds are held out and the steps have checkpoints."""
    if dataset.facts.control_mode == MOTORS:
        raise RecipeError(
            f"held_out: expected demonstrations of a task that is simulated, found those of an arm "
            f"({dataset.name}). Leave held_out out, and evaluate the checkpoint: mikasa-vla real."
        )
    if settings.every_steps % recipe.save_every_steps:
        raise RecipeError(
            f"held_out.every_steps is {settings.every_steps}, expected a multiple of finetune."
            f"save_every_steps ({recipe.save_every_steps}): what is evaluated is a checkpoint."
        )
    seeds = range(settings.seed_start, settings.seed_start + settings.episodes)
    # A checkpoint that was selected on the seeds of the tables would have a biased rate there.
    for used, what in (
        (EVALUATION_SEEDS, "tables are made from"),
        (dataset.seeds_tried, "were recorded from"),
    ):
        shared = sorted(set(seeds) & set(used))
        if shared:
            raise RecipeError(
                f"held_out.seed_start={settings.seed_start}, episodes={settings.episodes}: {len(shared)} "
                f"of these seeds ({shared[0]} … {shared[-1]}) are seeds that {what}. Held-out seeds serve "
                f"nothing else: choose another seed_start, or leave it out."
            )
    control_mode, tasks = dataset.facts.control_mode, dataset.facts.tasks
    if control_mode_of(settings.env) != control_mode:
        raise RecipeError(
            f"held_out.env.{CONTROL_MODE}: expected {control_mode}, the mode of the actions in "
            f"{dataset.name}, found {control_mode_of(settings.env)}. Set it: --set "
            f"held_out.env.{CONTROL_MODE}={control_mode}."
        )
    task = settings.task or dataset.facts.task
    if not task:
        names = f"is of {', '.join(tasks)}" if tasks else "names no task"
        raise RecipeError(
            f"held_out.task: {dataset.name} {names}; say which one to evaluate on (`mikasa-vla list tasks`)."
        )
    return task_spec(task).id


def check_asked(settings: HeldOutConfig, task: str, facts: TrainingFacts, *, policy: str) -> None:
    """Refuse an evaluation that gives a policy something else than it is trained with."""
    env = offered_by(task_spec(task), settings.env)
    sizes = {(camera.height_px, camera.width_px) for camera in env.cameras}
    images = dict.fromkeys(facts.images, sizes.pop())
    refuse_differences(differences(facts, Asked(env, images)), policy=policy, task=task)


def asked_warnings(facts: TrainingFacts, task: str | None, *, policy: str) -> list[str]:
    """Return what a person should know of evaluations before the training; `task` is the held-out one."""
    if task is not None:
        asked = instruction_for(task_spec(task))
        sentence = about_sentence(facts.sentences, asked, policy=policy, task=task)
        return [] if sentence is None else [sentence]
    if facts.control_mode == MOTORS:  # `mikasa-vla real` takes it
        return []
    robot = PANDA.name if facts.robot is None else facts.robot
    env = env_spec(control_mode=facts.control_mode, robot=robot)
    return [f"every evaluation would refuse this policy: {line}" for line in differences(facts, Asked(env))]


def shared_seeds_warning(dataset: "OpenDataset") -> str | None:
    """Return a warning if demonstrations are of seeds that tables are made from; None if none is.

    Recording refuses such seeds; a dataset from elsewhere, or of an earlier version, may have them.
    """
    shown = sorted(dataset.seeds_tried & set(EVALUATION_SEEDS))
    if not shown:
        return None
    return (
        f"warning: demonstrations are of {len(shown)} seeds that tables are made from ({shown[0]} … "
        f"{shown[-1]}). Evaluate on others (--seed-start), or leave them out: mikasa-vla dataset check-leak "
        f"{dataset.root}"
    )
