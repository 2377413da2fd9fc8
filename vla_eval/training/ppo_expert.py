"""PPO on the true state of the world, on a processor: an expert that is learned instead of scripted.

In the manner of CleanRL: one iteration is one episode in each environment, then a few epochs over it.
Episode seeds, noise and shuffles come from the settings' seed, and a checkpoint holds everything, so that
a continued run is the uninterrupted one, bit for bit. Checkpoints are safetensors and JSON, never pickles.
"""

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from vla_eval.decoding import decode
from vla_eval.envs.settings import EnvSettings
from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.policies.checkpoint_json import parse_json, read_json
from vla_eval.results.durable import LineFile, replace_file
from vla_eval.tasks.catalog import task_spec
from vla_eval.training.lockstep import LockstepEnvs
from vla_eval.training.ppo_network import ActorCritic, NetworkSpec
from vla_eval.training.ppo_settings import PpoSettings

CONFIG_FILE, WEIGHTS_FILE, PROGRESS_FILE, POLICY_FILE = (
    "config.json",
    "expert.safetensors",
    "progress.jsonl",
    "ppo_expert.yaml",
)
FORMAT_VERSION = 1
# Far from the evaluation's seeds (1 to 100) and those of demonstrations (from 1000).
FIRST_SEED = 10_000_000
SEEDS_PER_RUN = 10_000_000
SAVE_EVERY_SECONDS = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PpoProgress:
    """How far learning has come after an iteration.

    Attributes:
        n_steps: control steps of all environments together.
        success: share of the iteration's episodes in which the success rule held at some step.
        mean_reward: mean normalised dense reward per step, 1 at success.
        action_std: mean spread of the actions.
        steps_per_second: of this iteration, learning included.
    """

    n_steps: int
    success: float
    mean_reward: float
    action_std: float
    steps_per_second: float


class Rollout(NamedTuple):
    """One episode in each environment; T control steps, N environments."""

    states_TND: Tensor  # normalised
    actions_TNA: Tensor
    log_probability_TN: Tensor
    values_TN: Tensor  # one row more: the value after the last step
    rewards_TN: Tensor  # with shaping
    mean_reward: float  # without
    success: float


def train_expert(
    settings: PpoSettings,
    *,
    n_steps: int,
    out: Path,
    n_workers: int = 1,
    on_progress: Callable[[PpoProgress], bool] | None = None,
) -> PpoProgress:
    """Learn until so many control steps are done; goes on where an earlier call stopped.

    Args:
        settings: what is learned and how.
        n_steps: control steps of all environments together, rounded up to whole iterations.
        out: folder of the checkpoint.
        n_workers: processes; the result does not depend on it.
        on_progress: told after each iteration; returns whether to stop.

    Raises:
        CheckpointError: `out` holds another training, or a damaged one.
    """
    torch.set_num_threads(1)
    task = task_spec(settings.task)
    horizon = int(settings.env_kwargs.get("horizon_steps", task.horizon_steps))
    env = EnvSettings(
        task=task.id,
        kwargs=settings.env_kwargs,
        simulator=settings.simulator,
        privileged=True,
    )
    _begin_folder(out, settings)
    with LockstepEnvs(env, n_envs=settings.n_envs, n_workers=n_workers) as envs:
        learner = _Learner.begin(settings, envs, out)
        log, saved_at = LineFile(out / PROGRESS_FILE, durable=False), time.monotonic()
        progress = learner.progress
        try:
            while learner.n_steps < n_steps:
                begun = time.perf_counter()
                rollout = learner.collect(envs, horizon)
                learner.learn(rollout)
                progress = learner.report(rollout, seconds=time.perf_counter() - begun)
                log.append(json.dumps(dataclasses.asdict(progress)))
                stop = on_progress is not None and on_progress(progress)
                if stop or time.monotonic() - saved_at > SAVE_EVERY_SECONDS:
                    learner.save(out)
                    saved_at = time.monotonic()
                if stop:
                    break
        finally:
            log.close()
        learner.save(out)
    return progress


class _Learner:
    """Network, optimiser and generator of one training."""

    def __init__(self, settings: PpoSettings, n_state: int) -> None:
        self.settings = settings
        self.rng = torch.Generator().manual_seed(settings.seed)
        with torch.random.fork_rng(devices=[]):  # torch initialises layers from its global generator
            torch.manual_seed(settings.seed)
            self.network = ActorCritic(
                NetworkSpec(
                    n_state=n_state,
                    n_action=len(settings.learned_dims),
                    hidden=settings.hidden,
                    initial_std=settings.initial_std,
                )
            )
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=settings.learning_rate, eps=1e-5, foreach=False
        )
        self.n_steps = self.n_iterations = 0
        self.progress = PpoProgress(
            n_steps=0, success=0.0, mean_reward=0.0, action_std=settings.initial_std, steps_per_second=0.0
        )

    @classmethod
    def begin(cls, settings: PpoSettings, envs: LockstepEnvs, out: Path) -> "_Learner":
        """Make a new learner, or the one of the checkpoint."""
        n_state = envs.reset([FIRST_SEED] * settings.n_envs).states_ND.shape[1]
        learner = cls(settings, n_state)
        if (out / WEIGHTS_FILE).exists():
            learner.load(out)
        return learner

    @torch.no_grad()
    def collect(self, envs: LockstepEnvs, horizon: int) -> Rollout:
        """Play one episode in each environment."""
        n_envs = self.settings.n_envs
        first = FIRST_SEED + SEEDS_PER_RUN * self.settings.seed + self.n_iterations * n_envs
        result = envs.reset(range(first, first + n_envs))
        rows: list[tuple[Tensor, ...]] = []
        raw, rewards, to_go_m = [], [], [result.to_go_N]
        ever = np.zeros(n_envs, dtype=bool)
        for _ in range(horizon):
            states = torch.from_numpy(result.states_ND)
            normalized = self.network.normalize(states)
            noise = torch.randn((n_envs, len(self.settings.learned_dims)), generator=self.rng)
            decision = self.network.decide(normalized, noise=noise)
            result = envs.step(self.settings.full_actions(decision.actions.numpy()))
            rows.append((normalized, *decision))
            raw.append(states)
            rewards.append(torch.from_numpy(result.rewards_N))
            to_go_m.append(result.to_go_N)
            ever |= result.success_N
        last = self.network.critic(self.network.normalize(torch.from_numpy(result.states_ND))).squeeze(1)
        states, actions, log_probability, values = (torch.stack(column) for column in zip(*rows, strict=True))
        self.network.observe(torch.cat(raw))
        plain = torch.stack(rewards)
        potential = -self.settings.shaping_per_m * torch.from_numpy(np.stack(to_go_m))
        shaped = plain + potential[1:] - potential[:-1]
        self.n_steps += horizon * n_envs
        self.n_iterations += 1
        return Rollout(
            states,
            actions,
            log_probability,
            torch.cat([values, last[None]]),
            shaped,
            float(plain.mean()),
            float(ever.mean()),
        )

    def learn(self, rollout: Rollout) -> None:
        """Improve actor and critic by a few epochs over the rollout."""
        settings = self.settings
        # The horizon ends the recording, not the world: the value after it still counts.
        advantages = advantages_of(
            rollout.rewards_TN,
            rollout.values_TN,
            discount=settings.discount,
            gae_lambda=settings.gae_lambda,
        )
        returns = (advantages + rollout.values_TN[:-1]).flatten()
        flat = advantages.flatten()
        flat = (flat - flat.mean()) / (flat.std() + 1e-8)
        states, actions = rollout.states_TND.flatten(0, 1), rollout.actions_TNA.flatten(0, 1)
        before = rollout.log_probability_TN.flatten()
        for _ in range(settings.n_epochs):
            order = torch.randperm(len(flat), generator=self.rng)
            for rows in order.chunk(settings.n_minibatches):
                now = self.network.judge(states[rows], actions[rows])
                ratio = (now.log_probability - before[rows]).exp()
                clipped = ratio.clamp(1 - settings.clip, 1 + settings.clip)
                policy_loss = -torch.min(ratio * flat[rows], clipped * flat[rows]).mean()
                value_loss = 0.5 * ((now.value - returns[rows]) ** 2).mean()
                self.optimizer.zero_grad()
                (policy_loss + settings.value_weight * value_loss).backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.max_gradient_norm)
                self.optimizer.step()
            with torch.no_grad():
                log_ratio = self.network.judge(states, actions).log_probability - before
                # Source: Schulman, "Approximating KL divergence": unbiased, low variance.
                if float((log_ratio.exp() - 1 - log_ratio).mean()) > settings.max_kl:
                    break

    def report(self, rollout: Rollout, *, seconds: float) -> PpoProgress:
        """Say how far it has come."""
        self.progress = PpoProgress(
            n_steps=self.n_steps,
            success=rollout.success,
            mean_reward=rollout.mean_reward,
            action_std=float(self.network.log_std.detach().exp().mean()),
            steps_per_second=rollout.rewards_TN.numel() / seconds,
        )
        return self.progress

    def save(self, out: Path) -> None:
        """Write the checkpoint, whole or not at all."""
        tensors = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        for index, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{name}": tensor for name, tensor in state.items()}
        tensors["rng"] = self.rng.get_state()
        # One entry: the order of several differs from file to file.
        counts = {"n_steps": self.n_steps, "n_iterations": self.n_iterations}
        metadata = {"state": json.dumps({**counts, "progress": dataclasses.asdict(self.progress)})}
        draft = out / f"{WEIGHTS_FILE}.tmp"
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, draft, metadata)
        draft.replace(out / WEIGHTS_FILE)

    def load(self, out: Path) -> None:
        """Read the checkpoint."""
        tensors, metadata = _read_weights(out)
        load_network(self.network, tensors, where=out / WEIGHTS_FILE)
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith("adam."):
                _, index, key = name.split(".")
                state.setdefault(int(index), {})[key] = tensor
        if state:
            groups = self.optimizer.state_dict()["param_groups"]
            self.optimizer.load_state_dict({"state": state, "param_groups": groups})
        self.rng.set_state(tensors["rng"])
        where = f"{out / WEIGHTS_FILE}, its metadata"
        found = parse_json(metadata.get("state", "").encode(), where=where)
        try:
            self.n_steps, self.n_iterations = found["n_steps"], found["n_iterations"]
            self.progress = PpoProgress(**found["progress"])
        except (KeyError, TypeError) as exc:
            raise CheckpointError(f"{where}: no state of a training ({exc!r:.200}). Train it again.") from exc


def advantages_of(rewards_TN: Tensor, values_TN: Tensor, *, discount: float, gae_lambda: float) -> Tensor:
    """Return (T, N) generalised advantages. Source: Schulman et al. 2016, equation 16.

    Args:
        rewards_TN: rewards of T steps.
        values_TN: T + 1 values; the last is that of the state after the last step.
        discount: of later rewards.
        gae_lambda: of later errors.
    """
    advantages = torch.zeros_like(rewards_TN)
    running = torch.zeros_like(rewards_TN[0])
    for step in reversed(range(len(rewards_TN))):
        error = rewards_TN[step] + discount * values_TN[step + 1] - values_TN[step]
        running = error + discount * gae_lambda * running
        advantages[step] = running
    return advantages


def read_settings(out: Path) -> PpoSettings:
    """Return the settings of a training.

    Raises:
        CheckpointError: there is none in this folder, or it is damaged or of another version.
    """
    path = out / CONFIG_FILE
    try:
        data = read_json(path)
        if data.pop("format_version") == FORMAT_VERSION:
            return decode(PpoSettings, data, where=str(path))
    except (CheckpointError, ValueError, KeyError, TypeError, RecipeError) as exc:
        raise CheckpointError(
            f"{path}: no training of an expert ({exc!r:.200}). `mikasa-vla train-expert --out` makes one."
        ) from exc
    raise CheckpointError(f"{path}: of another version of this program. Train again into a new folder.")


def load_expert(out: Path) -> ActorCritic:
    """Return the network of a checkpoint; errors as `read_settings`."""
    settings = read_settings(out)
    tensors, _ = _read_weights(out)
    if "network.mean" not in tensors:
        raise CheckpointError(f"{out / WEIGHTS_FILE}: holds no expert. Train it again.")
    n_state = len(tensors["network.mean"])
    network = ActorCritic(
        NetworkSpec(n_state=n_state, n_action=len(settings.learned_dims), hidden=settings.hidden)
    )
    load_network(network, tensors, where=out / WEIGHTS_FILE)
    return network.eval()


def load_network(network: ActorCritic, tensors: dict[str, Tensor], *, where: Path) -> None:
    """Put the weights of a checkpoint into a network, exactly, or raise `CheckpointError`."""
    own = {name.removeprefix("network."): t for name, t in tensors.items() if name.startswith("network.")}
    try:
        network.load_state_dict(own, strict=True)
    except RuntimeError as exc:
        raise CheckpointError(f"{where}: weights of another network ({exc}).") from exc


def _begin_folder(out: Path, settings: PpoSettings) -> None:
    if (out / CONFIG_FILE).exists():
        found = read_settings(out)
        if found != settings:
            fields = [f.name for f in dataclasses.fields(settings)]
            changed = [name for name in fields if getattr(found, name) != getattr(settings, name)]
            raise CheckpointError(
                f"{out}: holds a training with another {', '.join(changed)}. Use a new --out, or the same "
                f"settings to go on."
            )
        return
    out.mkdir(parents=True, exist_ok=True)
    data = {"format_version": FORMAT_VERSION, **dataclasses.asdict(settings)}
    replace_file(out / CONFIG_FILE, f"{json.dumps(data, indent=2)}\n")
    description = f"PPO expert for {settings.task}, on the true state of the world."
    replace_file(
        out / POLICY_FILE,
        f'version: 1\ndescription: "{description}"\nadapter: ppo_expert\nargs: '
        f"{{checkpoint: {json.dumps(str(out.resolve()))}}}\n",
    )


def _read_weights(out: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    path = out / WEIGHTS_FILE
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in list(file.keys())}, file.metadata() or {}
    except (OSError, SafetensorError) as exc:
        raise CheckpointError(f"{path}: cannot be read ({exc}). Train again into a new folder.") from exc
