"""Replay the stored actions of a dataset in the simulator, and write into it whether they still succeed."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.environment import EnvSettings
from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.data.dataset_folder import found_or_how
from vla_eval.data.facts import DatasetFacts, read_facts
from vla_eval.data.manifest import (
    MIKASA_FOLDER,
    MIXTURE_FILE,
    RECORDING_FILE,
    RecordedEpisode,
    ReplayReport,
    keep_report,
    manifest_sha256,
    read_manifest,
)
from vla_eval.data.recording.record import RecordingObserver
from vla_eval.data.replaying.episode_check import STATE_TOLERANCE
from vla_eval.envs.factory import slow_modules
from vla_eval.errors import DatasetError, RecipeError, RecordingError
from vla_eval.features import CAMERA_KEYS
from vla_eval.storage.folders import check_writable
from vla_eval.storage.provenance import collect_environment
from vla_eval.strict.decoding import decode
from vla_eval.tasks.catalog import task_spec
from vla_eval.workers.backend import Backend, Pool
from vla_eval.workers.inside import RunnerClass
from vla_eval.workers.jobs import Answered, Job, JobList
from vla_eval.workers.local import LOCAL
from vla_eval.workers.messages import DeviceFound, Failed, as_exception
from vla_eval.workers.process import WorkerSpec

WORKER_MODULE = "vla_eval.data.replaying.worker"
MACHINE_FACTS = ("packages", "python", "platform", "cpu", "mesa", "nvidia_driver")
"""What of the environment may move the last bits of a state or a pixel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayJob(Job):
    """One episode to replay; `device` is the one that rendered the recording's images."""

    dataset: Path
    episode: RecordedEpisode
    env: EnvSettings
    pixels: bool
    same_machine: bool
    device: Mapping[str, str]

    @property
    def setup_key(self) -> Hashable:
        """See `workers.Job`."""
        return (self.dataset, self.pixels)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeReplayed:
    """The result of one episode: sentences about mismatches, and the video's quality by camera."""

    episode_index: int
    mismatches: tuple[str, ...]
    psnr_db: dict[str, float]


def find_datasets(path: Path) -> tuple[Path, ...]:
    """Return the datasets that a path names: itself, or those directly below it.

    Raises:
        DatasetError: there is none.
    """
    if (path / RECORDING_FILE).exists() or (path / MIXTURE_FILE).exists():  # of a mixture nothing is replayed
        return (path,)
    below = sorted(place.parent.parent.parent for place in path.glob(f"*/{RECORDING_FILE}"))
    if not below:
        raise DatasetError(
            f"{path}: holds no finished dataset (no {RECORDING_FILE}, here or one folder below). If a "
            f"recording was stopped, its command resumes it.{found_or_how(path)}"
        )
    return tuple(below)


def replay(
    dataset: Path,
    *,
    logs: Path,
    observer: RecordingObserver,
    episodes: Sequence[int] | None = None,
    pixels: bool = False,
    workers: int | Literal["auto"] = "auto",
    backend: Backend = LOCAL,
) -> ReplayReport | None:
    """Replay episodes of a dataset, by default all, and compare images, too, if `pixels`.

    The report of a whole dataset is written into it; that of a part only if it has found a mismatch. `logs`
    is a folder for what the workers write.

    Returns:
        The report; None if the observer asked to stop.

    Raises:
        VlaEvalError: the dataset is not complete, or has no such episode; the task has changed since; the
            simulator cannot be started.
    """
    facts, manifest = read_facts(dataset), read_manifest(dataset)
    if episodes is None:
        check_writable(dataset / MIKASA_FOLDER)
    environment = collect_environment()
    same_machine = all(facts.environment.get(name) == environment.get(name) for name in MACHINE_FACTS)
    jobs = _jobs(dataset, facts, _chosen(manifest, episodes, dataset), pixels, same_machine)
    observer.on_phase(facts.task, "replaying", n_done=0, n_total=len(jobs))
    size = max(1, min(len(jobs), backend.n_cores if workers == "auto" else workers))
    replayed: list[EpisodeReplayed] = []
    preload = (WORKER_MODULE, *slow_modules(job.env for job in jobs))
    spec = WorkerSpec(
        runner=RunnerClass(target=f"{WORKER_MODULE}:ReplayRunner"),
        answers=(EpisodeReplayed,),
        timeouts=TimeoutConfig(),
        logs=logs,
        preload=preload,
    )
    pool: Pool[ReplayJob, EpisodeReplayed] = backend.pool(spec, size=size)
    with pool as running:
        for event in running.run(JobList(jobs)):
            if isinstance(event, Answered):
                done = _episode_of(event)
                replayed.append(done)
                for mismatch in done.mismatches:
                    observer.on_mismatch(f"{dataset}: {_sentence(event.job, mismatch)}")
                observer.on_progress(n_done=len(replayed))
            elif not isinstance(event, DeviceFound) and observer.on_tick():
                return None
    report = _report(dataset, jobs, replayed, n_total=len(manifest), environment=environment)
    keep_report(dataset, report)
    return report


def _chosen(
    manifest: Sequence[RecordedEpisode], episodes: Sequence[int] | None, dataset: Path
) -> list[RecordedEpisode]:
    if episodes is None:
        return list(manifest)
    for number in episodes:
        if not 0 <= number < len(manifest):
            raise DatasetError(
                f"{dataset}: there is no episode {number}; it has the episodes 0 to {len(manifest) - 1}."
            )
    return [manifest[number] for number in dict.fromkeys(episodes)]


def _jobs(
    dataset: Path, facts: DatasetFacts, episodes: Sequence[RecordedEpisode], pixels: bool, same_machine: bool
) -> list[ReplayJob]:
    recipe = recipe_of(facts)
    check_task_versions(dataset, episodes)
    return [
        ReplayJob(
            dataset=dataset,
            episode=episode,
            env=EnvSettings(
                task=episode.task,
                kwargs=episode.env_kwargs,
                simulator=recipe.simulator,
                render=recipe.render,
                cameras=tuple(CAMERA_KEYS) if pixels else (),
            ),
            pixels=pixels,
            same_machine=same_machine,
            device=facts.device,
        )
        for episode in episodes
    ]


def check_task_versions(dataset: Path, episodes: Sequence[RecordedEpisode]) -> None:
    """Raise `DatasetError` if a task's rules are not those that an episode was recorded with."""
    for episode in episodes:
        version = task_spec(episode.task).version
        if episode.task_version != version:
            raise DatasetError(
                f"{dataset}: recorded with version {episode.task_version} of {episode.task}; this program "
                f"has version {version}, which has other rules. Record the dataset again."
            )


def recipe_of(facts: DatasetFacts) -> DatasetRecipe:
    """Return the recipe that a dataset was recorded by; raise `DatasetError` if it cannot be read."""
    try:
        return decode(DatasetRecipe, {"name": facts.name, **facts.recipe}, where=str(RECORDING_FILE))
    except RecipeError as exc:
        raise DatasetError(f"the dataset's own recipe cannot be read: {exc}") from exc


def _episode_of(event: Answered[ReplayJob, EpisodeReplayed]) -> EpisodeReplayed:
    """Return an episode's result; an episode that could not be replayed says nothing about the dataset."""
    if not isinstance(event.answer, Failed):
        return event.answer
    error = event.answer.error
    if event.answer.refused:
        raise as_exception(error)
    raise RecordingError(
        f"{event.job.dataset}: {_sentence(event.job, 'could not be replayed')}: {error.kind} during "
        f"{error.stage}: {error.message}\n{error.details or ''}"
    )


def _sentence(job: ReplayJob, mismatch: str) -> str:
    episode = job.episode
    return f"episode {episode.episode_index} (seed {episode.seed}): {mismatch}"


def _report(
    dataset: Path,
    jobs: Sequence[ReplayJob],
    replayed: Sequence[EpisodeReplayed],
    *,
    n_total: int,
    environment: Mapping[str, object],
) -> ReplayReport:
    by_number = {done.episode_index: done for done in replayed}
    in_order = [(job, by_number[job.episode.episode_index]) for job in jobs]
    mismatches = tuple(_sentence(job, text) for job, done in in_order for text in done.mismatches)
    cameras = sorted({camera for done in replayed for camera in done.psnr_db})
    same_machine = all(job.same_machine for job in jobs)
    return ReplayReport(
        passed=not mismatches,
        n_episodes=len(jobs),
        n_total=n_total,
        pixels=any(job.pixels for job in jobs),
        states_compared="bit-equal" if same_machine else f"within {STATE_TOLERANCE:g} (another machine)",
        mismatches=mismatches,
        lowest_psnr_db={
            camera: min(done.psnr_db[camera] for done in replayed if camera in done.psnr_db)
            for camera in cameras
        },
        manifest_sha256=manifest_sha256(dataset),
        environment=dict(environment),
    )
