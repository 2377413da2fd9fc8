"""Make the policy that is served, as an evaluation would, but without a simulator, and say what it is.

The environment that the policy is made for is the description of ours; an evaluation compares it with that of
its own simulator.
"""

from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any  # Any: arguments of an adapter

from vla_eval.checkpoints.execution_fields import ignored_fields
from vla_eval.checkpoints.files import find_checkpoint, read_facts
from vla_eval.checkpoints.notes import (
    AGENTS,
    COMPILE,
    LEROBOT_ADAPTER,
    checkpoint_hashes,
    training_seeds,
    training_sentences,
)
from vla_eval.chunking import ChunkingSettings
from vla_eval.config.files import Recipe, digest_of
from vla_eval.config.policy import PolicyRecipe
from vla_eval.control_modes import CONTROL_MODE, MOTORS
from vla_eval.core import BatchPolicy, Policy
from vla_eval.episode_log import check_reads_committed
from vla_eval.errors import RecipeError, SpecMismatchError, UnknownNameError
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.policies.compiled import Compilation, CompiledPolicy
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.recipe import load_policy_recipe
from vla_eval.policies.registry import POLICIES, PRIVILEGED, make_from_adapter
from vla_eval.policies.remote.settings import ADAPTER as REMOTE_ADAPTER
from vla_eval.robots.find import ROBOT
from vla_eval.robots.rows import PANDA
from vla_eval.serving.arm_env import arm_env
from vla_eval.serving.observations import (
    PROMPT_WIRE_KEY,
    STATE_WIRE_KEY,
    ObservationReader,
    observation_reader,
)
from vla_eval.specs import EnvSpec, check_compatible
from vla_eval.storage.provenance import PACKAGES, package_version
from vla_eval.strict.bounds import MAX_SERVER_ROWS, MAX_STEPS, check_bounds
from vla_eval.tasks.arguments import offered_by
from vla_eval.tasks.catalog import robot_task, task_spec
from vla_eval.tasks.interface import ANY_TASK, IMAGE_SIZE, env_spec
from vla_eval.wire.metadata import PROTOCOL, SUPPORTS, ServerMetadata
from vla_eval.wire.numbers import MEMORY

OWN_PACKAGE = "mikasa-vla-eval"


@dataclass(frozen=True, slots=True, kw_only=True)
class HostOptions:
    """Which policy is served, and how.

    Attributes:
        policy: name of a recipe, its file, or a folder with a checkpoint.
        task: for policies that depend on one; None: any.
        n_action_steps: for policies whose chunk has as many actions as are executed; None: the recipe's.
        max_batch: rows of a pass.
        device: what it runs on; None: as the recipe says.
        compile: whether its network is compiled; False: as the recipe says.
        chunking: how its chunks join, see `chunking.mode`; all else in it is the client's.
    """

    policy: str
    task: str | None = None
    n_action_steps: int | None = None
    max_batch: int = 16
    device: str | None = None
    compile: bool = False
    chunking: ChunkingSettings = field(default_factory=ChunkingSettings)

    def __post_init__(self) -> None:
        check_bounds(self, {"max_batch": (1, MAX_SERVER_ROWS), "n_action_steps": (1, MAX_STEPS)})


@dataclass(frozen=True, slots=True, kw_only=True)
class HostedPolicy:
    """A policy that is ready to be served.

    Attributes:
        task: the task of an episode whose client names none.
        env: what the policy was made for.
        ignored: what its checkpoint asks for that is not done here.
    """

    policy: Policy
    metadata: ServerMetadata
    reader: ObservationReader
    task: str
    env: EnvSpec
    ignored: tuple[str, ...] = ()

    def warm_up(self) -> Compilation | None:
        """Compile the policy's network if that was asked for; for the sentences that it was trained with."""
        if not isinstance(self.policy, CompiledPolicy):
            return None
        known = dict.fromkeys(chain.from_iterable((self.metadata.sentences or {}).values()))
        return self.policy.warm_up(self.env, tuple(known))

    @property
    def n_rows(self) -> int:
        """How many requests a pass has room for."""
        return self.metadata.batch_max or 1


def host_policy(options: HostOptions) -> HostedPolicy:
    """Make the policy.

    Raises:
        UnknownNameError: there is no such recipe, task or adapter.
        RecipeError: the policy depends on a task, and none is named; its recipe is wrong.
        SpecMismatchError: it needs what a client cannot send.
        CheckpointError: its weights are not there, or not whole.
    """
    recipe = load_policy_recipe(options.policy)
    _refuse_privileged(recipe.name, recipe.value.adapter in PRIVILEGED)
    if recipe.value.adapter == REMOTE_ADAPTER:
        raise SpecMismatchError(
            f"policy '{recipe.name}' is behind a socket already. Evaluate it by its own address: mikasa-vla "
            f"eval --policy {options.policy}"
        )
    env = _environment(recipe, options)
    hashes = checkpoint_hashes(recipe.value.adapter, recipe.value.args, policy=recipe.name)
    policy = _make(recipe, options, env)
    _refuse_privileged(recipe.name, policy.spec.privileged)
    check_compatible(policy.spec, env)
    check_reads_committed(policy.spec, options.chunking)
    end_effector = getattr(policy, "proprioception", None) == "eef"
    reader = observation_reader(policy.spec, env, end_effector=end_effector)
    return HostedPolicy(
        policy=policy,
        metadata=_describe(policy, recipe, reader, env, hashes, options),
        reader=reader,
        task=env.task,
        env=env,
        ignored=ignored_fields(recipe.value.adapter, recipe.value.args),
    )


def _environment(recipe: Recipe[PolicyRecipe], options: HostOptions) -> EnvSpec:
    """Return what the policy is made for: our tasks, with the control mode and images of its training."""
    task = None if options.task is None else task_spec(options.task)
    checkpoint = recipe.value.args.get("checkpoint")
    if recipe.value.adapter in AGENTS and isinstance(checkpoint, str):
        from vla_eval.policies.agents.network import read_about  # it imports torch

        about = read_about(find_checkpoint(Path(checkpoint)))
        return offered_by(robot_task(about.task, does="`serve` is for") if task is None else task, about.env)
    is_ours = recipe.value.adapter == LEROBOT_ADAPTER and isinstance(checkpoint, str)
    facts = read_facts(find_checkpoint(Path(checkpoint))) if is_ours and checkpoint else None
    if facts is None:
        return env_spec() if task is None else offered_by(task, {})
    if facts.control_mode == MOTORS:
        return arm_env(facts, task=ANY_TASK if task is None else task.id)
    sizes_px = {shape[0] for shape in facts.images.values()}
    size_px = sizes_px.pop() if len(sizes_px) == 1 else IMAGE_SIZE_PX
    robot = PANDA.name if facts.robot is None else facts.robot
    if task is None:
        return env_spec(control_mode=facts.control_mode, image_size_px=size_px, robot=robot)
    return offered_by(task, {ROBOT: robot, CONTROL_MODE: facts.control_mode, IMAGE_SIZE: size_px})


def _make(recipe: Recipe[PolicyRecipe], options: HostOptions, env: EnvSpec) -> Policy:
    n_action_steps = options.n_action_steps or recipe.value.default_n_action_steps
    args: dict[str, Any] = dict(recipe.value.args)
    if options.device is not None:
        args["device"] = options.device
    if options.compile:
        args[COMPILE] = True
    context = PolicyContext(
        name=recipe.name,
        env=env,
        chunking=_joining(options.chunking).at(n_action_steps),
        n_candidates=0,  # a policy that depends on them is privileged
        n_slots=options.max_batch,
    )
    try:
        return make_from_adapter(recipe.value.adapter, context, args)
    except UnknownNameError as exc:
        if options.task is None and f"'{ANY_TASK}'" in str(exc):
            raise RecipeError(
                f"policy '{recipe.name}' depends on the task. Name it: --task RememberColor3-v0."
            ) from exc
        raise


def _joining(chunking: ChunkingSettings) -> ChunkingSettings:
    """Return what a policy has to know to join its chunks; their execution is the client's."""
    if not chunking.execution.commits:
        return ChunkingSettings()
    return ChunkingSettings(mode=chunking.mode, rtc=chunking.rtc)


def _refuse_privileged(name: str, is_privileged: bool) -> None:
    if is_privileged:
        raise SpecMismatchError(
            f"policy '{name}' reads the true state of the world, which is not sent to a server. Evaluate it "
            f"in the process of the simulator: mikasa-vla eval --policy {name}"
        )


def _describe(
    policy: Policy,
    recipe: Recipe[PolicyRecipe],
    reader: ObservationReader,
    env: EnvSpec,
    hashes: dict[str, str],
    options: HostOptions,
) -> ServerMetadata:
    layouts = reader.state_layouts
    weights = {name: digest for name, digest in hashes.items() if name.startswith("checkpoints/")}
    versions = {name: package_version(name) for name in (OWN_PACKAGE, *PACKAGES)}
    return ServerMetadata(
        protocol=PROTOCOL,
        name=recipe.name,
        # Of another package's adapter it is not known which weights it reads.
        weights_known=recipe.value.adapter in POLICIES,
        weights_sha256=_digest(weights),
        recipe_sha256=recipe.sha256,
        chunk_size=policy.spec.chunk_size,
        n_action_steps=options.n_action_steps or recipe.value.default_n_action_steps,
        control_mode=env.action.control_mode,
        action_dims=env.action.dims,
        control_hz=env.control_hz,
        cameras=reader.cameras,
        state_key=STATE_WIRE_KEY if layouts else None,
        state_dims=next(iter(layouts.values()), None),
        state_layouts=layouts,
        prompt_key=PROMPT_WIRE_KEY,
        needs_every_frame=policy.spec.reads == "every",
        needs_session_id=True,
        batch_max=options.max_batch if isinstance(policy, BatchPolicy) else 1,
        supports=(*SUPPORTS, MEMORY) if policy.spec.has_memory else SUPPORTS,
        versions={name: version for name, version in versions.items() if version is not None},
        training_seeds=training_seeds(recipe.value.adapter, recipe.value.args) or None,
        sentences=training_sentences(recipe.value.adapter, recipe.value.args),
        chunking_mode=options.chunking.mode if policy.spec.reads_committed else None,
        other={
            **({COMPILE: True} if options.compile or recipe.value.args.get(COMPILE) else {}),
            **({"rtc": asdict(options.chunking.rtc)} if options.chunking.execution.is_guided else {}),
        },
    )


def _digest(weights: dict[str, str]) -> str | None:
    """Return the digest of the weights; of an adapter and the base that the recipe names, of both."""
    if len(weights) < 2:
        return next(iter(weights.values()), None)
    return digest_of(sorted(weights.values()))
