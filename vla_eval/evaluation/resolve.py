"""What a person asks to be evaluated, with all that was left open decided: made once, at the door."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self  # Any: plain data

from vla_eval.checkpoints.notes import AGENTS, COMPILE, LEROBOT_CHECKPOINTS
from vla_eval.config.environment import AS_DESIGNED
from vla_eval.config.evaluation import OPTION_FIELDS, EvalConfig
from vla_eval.config.files import Recipe, content_of, digest_of
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.recorded_chunking import recorded_chunking
from vla_eval.errors import RecipeError, some_of
from vla_eval.evaluation.delay_trace import RunDelays
from vla_eval.policies.entries import PolicyEntry, load_policy_entries
from vla_eval.policies.recipe import bare_policy
from vla_eval.storage.shard import Shard, shard_folder
from vla_eval.storage.starting import RUNS_FOLDER
from vla_eval.tasks.arguments import pinned
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.workers.backend import Backend
from vla_eval.workers.local import LOCAL

FINGERPRINT_DIGITS = 8
INFERENCE_FIELDS = ("inference", "inference_max_batch")


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedEvaluation:
    """An evaluation as it will run."""

    config: EvalConfig  # what was asked for; `inference` is never `auto`
    # those of the configuration, each read once; a policy server asked once
    policies: tuple[PolicyEntry, ...]
    backend: Backend
    shard: Shard | None  # the part of the episodes that is run; None: all
    named_out: Path | None  # the run folder that was asked for; None: the default one
    delays: RunDelays | None = None  # those that `chunking.delay.trace` names

    @classmethod
    def of(
        cls,
        config: EvalConfig,
        policies: Sequence[PolicyEntry],
        *,
        backend: Backend = LOCAL,
        out: Path | None = None,
        shard: Shard | None = None,
    ) -> Self:
        """Decide where policies infer; arguments as for `resolve`, with the policies that were read."""
        if config.compile:
            policies = _compiled(policies)
        config = replace(config, env=pinned(config.env, [task_spec(task) for task in config.tasks]))
        if config.inference == "auto":
            config = replace(
                config, inference="shared" if _shares(config, policies, backend) else "in_process"
            )
        return cls(
            config=config,
            policies=tuple(policies),
            backend=backend,
            shard=shard,
            named_out=out,
            delays=RunDelays.of(config.chunking),
        )

    @property
    def out(self) -> Path:
        """The run folder."""
        return self.named_out or shard_folder(self.default_folder, self.shard)

    @property
    def default_folder(self) -> Path:
        """The folder of the whole run, if none is named: the same for the same configuration."""
        return RUNS_FOLDER / f"{self.config.name}-{self.fingerprint[:FINGERPRINT_DIGITS]}"

    @property
    def fingerprint(self) -> str:
        """The sha256 of the part of the configuration that results depend on."""
        return digest_of(self.results_config)

    @property
    def results_config(self) -> dict[str, Any]:
        """The part of the configuration that results depend on; compared when a run is resumed."""
        config = self.config
        data = content_of(config, options=OPTION_FIELDS)
        # So that runs of versions without these fields can be resumed.
        if config.slots_per_worker == 1:
            del data["slots_per_worker"]
        if config.inference == "in_process":
            data = {name: value for name, value in data.items() if name not in INFERENCE_FIELDS}
        data["env"] = without_path(data["env"])
        data["policies"] = [bare_policy(name) for name in data["policies"]]
        if not config.compile:
            del data["compile"]
        if config.reset_policy_at_step is None:
            del data["reset_policy_at_step"]
        data["chunking"] = recorded_chunking(config.chunking, data["chunking"])
        if config.cue_view == "as_shown":
            del data["cue_view"]
        if config.memory_change is None:
            del data["memory_change"]
        if config.appearance == AS_DESIGNED:
            del data["appearance"]
        return data

    @property
    def shared(self) -> dict[str, str]:
        """`EpisodeGroup.part` whose inference all workers share -> what the configuration calls it."""
        if self.config.inference == "in_process":
            return {}
        return {
            policy.part(index): text
            for policy in self.policies
            for index, text in enumerate(policy.texts)
            if has_weights(policy.recipes[index].value)
        }


def resolve(
    config: EvalConfig, *, backend: Backend = LOCAL, out: Path | None = None, shard: Shard | None = None
) -> ResolvedEvaluation:
    """Read the policies of a configuration, ask policy servers, and decide what it leaves open."""
    policies = load_policy_entries(config.policies)
    return ResolvedEvaluation.of(config, policies, backend=backend, out=out, shard=shard)


def has_weights(recipe: PolicyRecipe) -> bool:
    """Whether a policy's recipe names a checkpoint, not of an agent: only such policies are shared."""
    return isinstance(recipe.args.get("checkpoint"), str) and recipe.adapter not in AGENTS


def _compiled(policies: Sequence[PolicyEntry]) -> tuple[PolicyEntry, ...]:
    """Return the policies with `compile` in the arguments of those that load a checkpoint of LeRobot's."""
    if not any(entry.value.adapter in LEROBOT_CHECKPOINTS for entry in policies):
        raise RecipeError(
            "compile: expected a policy with a checkpoint, found "
            f"{some_of(entry.name for entry in policies)}. Leave it out. A policy server is started with it "
            "(mikasa-vla serve --compile)."
        )
    return tuple(
        replace(entry, recipes=tuple(map(_with_compile, entry.recipes)))
        if entry.value.adapter in LEROBOT_CHECKPOINTS
        else entry
        for entry in policies
    )


def _with_compile(recipe: Recipe[PolicyRecipe]) -> Recipe[PolicyRecipe]:
    value = recipe.value
    return replace(recipe, value=replace(value, args={**value.args, COMPILE: True}))


def _shares(config: EvalConfig, policies: Sequence[PolicyEntry], backend: Backend) -> bool:
    """Whether workers share inference where it is left open: on a GPU, with several workers and weights."""
    n_workers = backend.n_cores if config.workers == "auto" else config.workers
    recipes = (recipe.value for entry in policies for recipe in entry.recipes)
    return n_workers > 1 and bool(backend.n_gpus) and any(map(has_weights, recipes))
