"""Trainings of agents that take a second."""

from pathlib import Path
from typing import Any

from vla_eval.agents.train import train_agent
from vla_eval.config.agents import AgentConfig

BIT = "mikasa_base/MemoryLengthEasy-v0"
ROBOT = "RememberColor3-v0"
TINY: dict[str, dict[str, Any]] = {
    "ppo": {
        "n_envs": 2,
        "steps": 48,
        "save_every_steps": 16,
        "arguments": {"n_steps": 8, "batch_size": 8, "n_epochs": 2},
        "network": {"net_arch": [8]},
    },
    "ppo_lstm": {
        "n_envs": 2,
        "steps": 48,
        "save_every_steps": 16,
        "arguments": {"n_steps": 8, "batch_size": 8, "n_epochs": 2},
        "network": {"net_arch": [8], "lstm_hidden_size": 4},
    },
    "sac": {
        "n_envs": 2,
        "steps": 48,
        "save_every_steps": 16,
        "arguments": {
            "batch_size": 8,
            "learning_starts": 4,
            "buffer_size": 60,
            "gradient_steps": 1,
            "train_freq": 1,
        },
        "network": {"net_arch": [8]},
    },
    "imitation": {
        "n_envs": 2,
        "steps": 48,
        "save_every_steps": 16,
        "arguments": {"demonstrations": 3, "batch_size": 2, "action_noise": 0.0},
        "network": {"core": "gru", "width": 8},
    },
}


def tiny(algorithm: str, out: Path, task: str = ROBOT, **changes: Any) -> AgentConfig:
    """Return a training of an algorithm, of a robot task in the fake simulator."""
    fields = {"env": {}, **TINY[algorithm], **changes.pop("train_agent", {})}
    is_base = task.startswith("mikasa_base")
    fields["simulator"] = "maniskill" if is_base else "fake"
    if algorithm == "imitation" and not is_base:  # so that what is exchanged is resumed, too
        fields["arguments"] = {"exchange_share": 0.5, **fields["arguments"]}
    settings: dict[str, Any] = {
        "policy": f"{algorithm}_base" if is_base else algorithm,
        "task": task,
        "out": str(out),
        **changes,
    }
    return AgentConfig(train_agent=fields, **settings)


class StopAfter:
    """Says to stop once it was asked so many times: at each step of all environments."""

    def __init__(self, n_asked: int) -> None:
        self.n_left = n_asked

    def __call__(self) -> bool:
        self.n_left -= 1
        return self.n_left < 0


def trained(config: AgentConfig) -> Path:
    """Train to the end, and return the run's folder."""
    return train_agent(config).out
