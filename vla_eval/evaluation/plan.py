"""A configuration's episodes: task x policy x n_action_steps x run x seed; and its mistakes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from typing import Any

from vla_eval.checkpoints.execution_fields import ignored_fields
from vla_eval.checkpoints.notes import (
    checkpoint_hashes,
    normalization_notes,
    training_seeds,
    training_sentences,
)
from vla_eval.checkpoints.trained_with import Sentences, about_nothing_known, about_sentence
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.evaluation import EvalConfig
from vla_eval.config.files import Recipe, digest_of
from vla_eval.config.prompts import PromptRecipe, load_prompts, sentences_of
from vla_eval.control_modes import RELATIVE_MODES
from vla_eval.cue_view import CueViewSettings
from vla_eval.envs.factory import describe_env
from vla_eval.errors import RecipeError
from vla_eval.evaluation.delay_trace import RunDelays
from vla_eval.evaluation.donors import donor_settings
from vla_eval.evaluation.episode_jobs import EpisodeGroup, EpisodeJob, GroupKey
from vla_eval.evaluation.plan_checks import (
    check_base,
    check_changes,
    check_chunks,
    check_devices,
    check_instruction,
    check_runs,
    check_tasks,
    refuse_doubles,
    refuse_instruction,
    steps_of,
)
from vla_eval.evaluation.resolve import ResolvedEvaluation, has_weights
from vla_eval.latency import MEASURED
from vla_eval.policies.entries import PolicyEntry
from vla_eval.policies.registry import check_adapter
from vla_eval.rollout import RolloutSettings
from vla_eval.seeding import SeedRange
from vla_eval.storage.planned import part_of
from vla_eval.storage.shard import Shard
from vla_eval.storage.trained_on import seen_in_training
from vla_eval.strict.bounds import MAX_EPISODES
from vla_eval.tasks.arguments import meshes_of
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.spec import TaskSpec
from vla_eval.wire.metadata import ServerMetadata


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The episodes of a run, and facts about them."""

    jobs: tuple[EpisodeJob, ...]  # every episode, in a fixed order
    # `policies/random` -> sha256 of the file; likewise the prompts, the files of meshes, the weights of
    # learned policies, and the datasets that these were trained on (another dataset of the same name is
    # `datasets/NAME of POLICY`). Several checkpoints of one policy are `policies/NAME/run-0` and so on,
    # those for one task `policies/NAME/TASK/run-0`.
    recipe_hashes: Mapping[str, str]
    # learned policy -> by which statistics it normalises, see `normalization_notes`
    normalization: Mapping[str, Mapping[str, Any]]  # Any: plain data
    # policy behind a socket -> its server's metadata
    servers: Mapping[str, Mapping[str, Any]]  # Any: plain data
    # policy with weights, one of several checkpoints as in `recipe_hashes` -> those it was trained with,
    # see `Sentences`; None where that is not known
    sentences: Mapping[str, Sentences | None]
    # policy, one of several checkpoints as in `recipe_hashes` -> task -> the seeds whose demonstrations
    # it was trained on, where known
    training_seeds: Mapping[str, Mapping[str, tuple[SeedRange, ...]]]
    task_versions: Mapping[str, int]
    policy_names: tuple[str, ...]  # what records call the policies, in the order of the configuration
    # `EpisodeGroup.part` whose inference all workers share -> what the configuration calls it
    shared: Mapping[str, str]
    left_out: tuple[str, ...]  # (task, policy) pairs that make no sense together, and why, for a message
    # the most workers that `workers: auto` may start, since each loads the policies that are not shared;
    # None: no limit
    max_workers: int | None
    ignored: tuple[str, ...] = ()  # what checkpoints ask for that is not done here, see `ignored_fields`
    # the part of the configuration's episodes that `jobs` are; None: all of them
    shard: Shard | None = None
    delays: RunDelays | None = None  # those that are replayed
    about_meshes: str | None = None  # a note on a folder of meshes

    @property
    def warnings(self) -> list[str]:
        """What a person should know before the first episode."""
        asked = dict.fromkeys((one.part, one.key.task, one.instruction) for one in self._groups)
        other = [
            about_sentence(self.sentences.get(part), sentence, policy=part, task=task)
            for part, task, sentence in asked
        ]
        seen = seen_in_training((job.key for job in self.jobs), self.training_seeds)
        return [*self.ignored, *seen, *(line for line in other if line is not None)]

    @property
    def notes(self) -> list[str]:
        """What could not be compared, and what was read."""
        parts = dict.fromkeys(group.part for group in self._groups)
        unknown = [part for part in parts if part in self.sentences and self.sentences[part] is None]
        replayed = [] if self.delays is None else [self.delays.note([job.key for job in self.jobs])]
        nothing_known = [about_nothing_known(part) for part in unknown]
        meshes = [] if self.about_meshes is None else [self.about_meshes]
        about_chunks = [*self.about_measured, *self.about_skipped, *self.about_averaged]
        return [*meshes, *nothing_known, *replayed, *about_chunks]

    @property
    def about_measured(self) -> list[str]:
        """A note where measured delays are not those of an episode alone."""
        measured = [group for group in self._groups if group.rollout.chunking.delay == MEASURED]
        if not measured or (max(group.n_rows for group in measured) == 1 and not self.shared):
            return []
        return [
            "chunking.delay is measured, and episodes share passes of the policy: the delay of each is that "
            "of the whole pass. For that of a robot: workers=1, slots_per_worker=1, inference=in_process."
        ]

    @property
    def about_skipped(self) -> list[str]:
        """A note where a delay makes motion get lost."""
        modes = self._relative_modes(lambda chunking: chunking.delay != 0 and chunking.is_aligned)
        return [
            f"chunking.delay with delay_alignment=skip: actions of {mode} are relative, and what is skipped "
            "is motion that is lost: arms stop before the target. delay_alignment=stale executes it late; "
            "pd_joint_pos and pd_ee_pose have absolute targets (docs/real_time.md#relative-actions)."
            for mode in modes
        ]

    @property
    def about_averaged(self) -> list[str]:
        """A note where plans of relative actions are averaged."""
        modes = self._relative_modes(lambda chunking: chunking.execution.averages)
        return [
            f"chunking.mode=temporal_ensemble: actions of {mode} are relative, and those of a step are "
            "planned from different places: their mean moves the arm too little, most of all where it sets "
            "out (docs/real_time.md#relative-actions)."
            for mode in modes
        ]

    def _relative_modes(self, chosen: Callable[[ChunkingSpec], bool]) -> list[str]:
        """Return the control modes of relative actions that are executed in a chosen way."""
        groups = (group for group in self._groups if chosen(group.rollout.chunking))
        modes = dict.fromkeys(group.offered.action.control_mode for group in groups)
        return [mode for mode in modes if mode in RELATIVE_MODES]

    @property
    def _groups(self) -> list[EpisodeGroup]:
        return list({id(job.group): job.group for job in self.jobs}.values())


def make_plan(resolved: ResolvedEvaluation) -> Plan:
    """Plan the episodes of an evaluation, or of its shard; a `VlaEvalError` if anything cannot be run."""
    config, policies = resolved.config, resolved.policies
    refuse_instruction(config)
    tasks = [task_spec(task) for task in config.tasks]
    refuse_doubles("tasks", [task.id for task in tasks])
    refuse_doubles("policies", [part_of(one.name, task=one.task) for one in policies])
    check_tasks(tasks, policies)
    check_runs(config, policies)
    check_devices(resolved)
    prompts = load_prompts(config.prompt_set)
    servers = {policy.name: policy.server for policy in policies if policy.server is not None}
    shared = resolved.shared
    groups, left_out = _groups_of_all(config, tasks, policies, prompts=prompts, shared=shared)
    if resolved.delays is not None:
        groups = [_with_delays(group, resolved.delays) for group in groups]
    check_chunks(config, policies)
    if not groups:
        raise RecipeError(f"{config.name}: there is nothing to run ({'; '.join(left_out)}).")
    _refuse_too_many(config, groups)
    meshes = meshes_of(config.env)
    limits = [policy.value.max_workers for policy in policies if policy.part(0) not in shared]
    ignored = [ignored_fields(one.adapter, one.args, chunking=one.rollout.chunking) for one in groups]
    plan = Plan(
        jobs=tuple(job for group in groups for job in _jobs(config, group)),
        recipe_hashes={
            **_recipe_hashes(prompts, policies, servers),
            **_delays_hash(resolved.delays),
            **({} if meshes is None else meshes.hashes),
        },
        normalization=_noted(policies, normalization_notes),
        servers={name: server.identity() for name, server in servers.items()},
        sentences=_sentences(policies, servers),
        training_seeds={
            **_noted(policies, training_seeds),
            **{name: server.training_seeds for name, server in servers.items() if server.training_seeds},
        },
        task_versions={task.id: task.version for task in tasks},
        policy_names=tuple(dict.fromkeys(policy.name for policy in policies)),
        shared=shared,
        left_out=tuple(left_out),
        max_workers=min((limit for limit in limits if limit is not None), default=None),
        ignored=tuple(dict.fromkeys(chain.from_iterable(ignored))),
        delays=resolved.delays,
        about_meshes=None if meshes is None else meshes.note,
    )
    return plan if resolved.shard is None else _shard_of(plan, config, resolved.shard)


def _shard_of(plan: Plan, config: EvalConfig, shard: Shard) -> Plan:
    """Return one shard; slots, rows and run numbers stay those of the whole plan, and so do records."""
    groups = tuple(dict.fromkeys(job.group.key for job in plan.jobs))
    # Episodes that run side by side stay together, so that a batch has the same neighbours as in one run.
    own = replace(shard.of_blocks(config.slots_per_worker, config.episodes), groups=groups)
    jobs = tuple(job for job in plan.jobs if own.holds(job.seed - config.seed_start))
    return replace(plan, jobs=jobs, shard=own)


def _groups_of_all(
    config: EvalConfig,
    tasks: Sequence[TaskSpec],
    policies: Sequence[PolicyEntry],
    *,
    prompts: Recipe[PromptRecipe],
    shared: Mapping[str, str],
) -> tuple[list[EpisodeGroup], list[str]]:
    """Return the groups of every task and policy that make sense together, and which pairs are left out."""
    groups: list[EpisodeGroup] = []
    left_out: list[str] = []
    for task in tasks:
        env = EnvSettings(
            task=task.id,
            kwargs=config.env,
            simulator=config.simulator,
            sim_backend=config.sim_backend,
            render=config.render,
            appearance=config.appearance,
            n_slots=config.slots_per_worker,
        )
        offered = describe_env(env)
        check_changes(config, task, offered)
        if config.memory_change is not None:
            describe_env(donor_settings(env, config.memory_change))  # refuses arguments that it does not take
        check_base(config, task)
        on_task = partial(
            EpisodeGroup,
            env=env,
            offered=offered,
            n_candidates=task.n_candidates(config.env),
            instruction=sentences_of(prompts, task)[0],
            memory_change=config.memory_change,
        )
        for policy in (policy for policy in policies if policy.task in (None, task.id)):
            check_adapter(policy.value.adapter)
            check_instruction(policy, offered)
            if policy.value.needs_candidates and not task.has_candidates:
                left_out.append(f"{policy.name} on {task.id}: it needs candidates, and this task has none")
                continue
            if policy.value.adapter in task.lacks:
                left_out.append(f"{policy.name} on {task.id}: no such player is known for this task")
                continue
            n_rows = config.inference_max_batch if policy.part(0) in shared else config.slots_per_worker
            groups.extend(_groups(config, task, policy, on_task, n_rows=n_rows))
    return groups, left_out


def _jobs(config: EvalConfig, group: EpisodeGroup) -> Iterable[EpisodeJob]:
    for run in _runs(config, group):
        for index in range(config.episodes):
            yield EpisodeJob(
                group=group,
                run=run,
                seed=config.seed_start + index,
                slot=index % config.slots_per_worker,
                row=index % group.n_rows,
            )


def _with_delays(group: EpisodeGroup, delays: RunDelays) -> EpisodeGroup:
    trace = delays.narrowed(**group.key._asdict())
    return replace(group, rollout=replace(group.rollout, delay_trace=trace))


def _delays_hash(delays: RunDelays | None) -> dict[str, str]:
    return {} if delays is None else {f"delays/{delays.path.name}": delays.sha256}


def _noted[T](
    policies: Sequence[PolicyEntry],
    note: Callable[[str, Mapping[str, Any]], T],  # Any: whatever the adapter takes
) -> dict[str, T]:
    """Return what is noted of each policy's checkpoints by adapter and arguments; nothing that is empty."""
    return {
        policy.part(index): noted
        for policy in policies
        for index, recipe in enumerate(policy.recipes)
        if (noted := note(recipe.value.adapter, recipe.value.args))
    }


def _sentences(
    policies: Sequence[PolicyEntry], servers: Mapping[str, ServerMetadata]
) -> dict[str, Sentences | None]:
    """Return what each policy with weights was trained with, see `Plan.sentences`."""
    here: dict[str, Sentences | None] = {
        policy.part(index): training_sentences(recipe.value.adapter, recipe.value.args)
        for policy in policies
        for index, recipe in enumerate(policy.recipes)
        if has_weights(recipe.value)
    }
    has_none = [
        name for name, server in servers.items() if server.weights_known and not server.weights_sha256
    ]
    there = {name: server.sentences for name, server in servers.items() if name not in has_none}
    return {**here, **there}


def _runs(config: EvalConfig, group: EpisodeGroup) -> Sequence[int]:
    return range(config.runs) if group.checkpoint is None else (group.checkpoint,)


def _recipe_hashes(
    prompts: Recipe[PromptRecipe], policies: Sequence[PolicyEntry], servers: Mapping[str, ServerMetadata]
) -> dict[str, str]:
    """Return the digests of all files that results depend on, see `Plan`."""
    hashes = {f"prompts/{prompts.name}": prompts.sha256}
    for policy in policies:
        for index, recipe in enumerate(policy.recipes):
            part = policy.part(index)
            hashes[f"policies/{part}"] = recipe.sha256
            digests = checkpoint_hashes(recipe.value.adapter, recipe.value.args, policy=part)
            for name, digest in digests.items():
                # Two datasets may have one name. The first keeps it, so that a run grows by further policies.
                is_other = hashes.get(name, digest) != digest
                hashes[f"{name} of {part}" if is_other else name] = digest
    for name, server in servers.items():
        if server.weights_sha256 is not None:
            hashes[f"checkpoints/{name}"] = server.weights_sha256
    return hashes


def _refuse_too_many(config: EvalConfig, groups: Sequence[EpisodeGroup]) -> None:
    n_episodes = sum(len(_runs(config, group)) for group in groups) * config.episodes
    if n_episodes > MAX_EPISODES:
        n_rows = len({group.key for group in groups})
        raise RecipeError(
            f"{config.name}: {n_rows} groups (task, policy, n_action_steps), {config.runs} runs and "
            f"{config.episodes} episodes make {n_episodes} episodes, expected at most {MAX_EPISODES} in one "
            f"run folder. Use fewer, or several configurations."
        )


def _groups(
    config: EvalConfig, task: TaskSpec, policy: PolicyEntry, on_task: partial[EpisodeGroup], *, n_rows: int
) -> Iterable[EpisodeGroup]:
    server = policy.server
    for n_action_steps, (index, recipe) in product(steps_of(config, policy, task), enumerate(policy.recipes)):
        args = recipe.value.args
        if server is not None:
            args = {**args, "identity_sha256": digest_of(server.identity())}  # workers compare
            n_rows = server.batch_max or n_rows
        yield on_task(
            key=GroupKey(task.id, policy.name, n_action_steps),
            adapter=recipe.value.adapter,
            args=args,
            rollout=RolloutSettings(
                chunking=config.chunking.at(n_action_steps),
                eager_rendering=config.eager_rendering,
                stop_at_success=config.stop_at_success,
                reset_policy_at_step=config.reset_policy_at_step,
                cue_view=CueViewSettings(
                    kind=config.cue_view, begins_at=config.env.get("cue_after_steps", 0)
                ),
            ),
            n_rows=n_rows,
            checkpoint=index if policy.is_by_run else None,
            part=policy.part(index),
        )
