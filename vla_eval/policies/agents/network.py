"""An agent's network as files: `config.json` says how it is built, `model.safetensors` holds the weights.

The library's own archive holds pickles; it is neither written nor read.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast  # torch modules of the library

import gymnasium as gym
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from vla_eval.checkpoints.files import CONFIG_FILE, WEIGHTS_FILE, unreadable
from vla_eval.config.agents import Algorithm as AlgorithmName
from vla_eval.config.agents import Observed
from vla_eval.config.files import to_data
from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.models.families import AGENT
from vla_eval.policies.agents.algorithms import algorithm, network_class, network_fields
from vla_eval.policies.agents.observing import IMAGE, given_space
from vla_eval.strict.decoding import decode
from vla_eval.strict.json_fields import FETCH_AGAIN, read_json

MAX_DIMS = 1_000_000  # of an input: a number beyond it is a damaged file


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentNetwork:
    """What a network was made for and of."""

    algorithm: AlgorithmName
    observation: Observed
    task: str
    env: dict[str, Any]  # arguments of the task; Any: of whatever types
    shapes: dict[str, tuple[int, ...]]  # of what it is given, by name
    action_dims: tuple[str, ...]
    control_mode: str
    network: dict[str, Any] = field(default_factory=dict)  # Any: as in the recipe
    type: str = AGENT
    chunk_size: int = 1
    n_action_steps: int = 1

    def __post_init__(self) -> None:
        sizes = [size for shape in self.shapes.values() for size in shape]
        if not sizes or not all(0 < size <= MAX_DIMS for size in sizes):
            raise RecipeError(f"shapes {self.shapes}: expected one whole number or more for each input.")


def save_network(folder: Path, about: AgentNetwork, weights: Mapping[str, Any]) -> None:
    """Write a network; weights that several parts share are written for each."""
    folder.mkdir(parents=True)
    (folder / CONFIG_FILE).write_text(f"{json.dumps(to_data(about), indent=2)}\n", encoding="utf-8")
    own = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in weights.items()}
    save_file(own, folder / WEIGHTS_FILE)


def read_about(folder: Path) -> AgentNetwork:
    """Return what a network's `config.json` says."""
    path = folder / CONFIG_FILE
    try:
        return decode(AgentNetwork, read_json(path), where=str(path))
    except RecipeError as exc:
        raise CheckpointError(f"{exc} The file was changed; train the agent again, or {FETCH_AGAIN}") from exc


def reads_images(folder: Path) -> bool:
    """Whether an agent is given images."""
    return IMAGE in read_about(folder).shapes


def load_network(folder: Path, about: AgentNetwork, action: gym.Space[Any]) -> Any:
    """Return the network with its weights, ready to be asked.

    Raises:
        CheckpointError: the weights are damaged, or not of such a network.
    """
    row = algorithm(about.algorithm)
    fields = network_fields(row, about.network)
    network = network_class(row)(given_space(about.shapes), action, lambda _progress: 0.0, **fields)
    file = folder / WEIGHTS_FILE
    try:
        weights = load_file(file)
    except (SafetensorError, OSError) as exc:
        raise unreadable(file, exc) from exc
    try:
        network.load_state_dict(weights)
    except RuntimeError as exc:  # torch names what is missing, left over, or of another shape
        said = " ".join(str(exc).split())
        raise CheckpointError(
            f"{file}: expected the weights of the network that {CONFIG_FILE} describes ({said:.400}). "
            f"{FETCH_AGAIN}"
        ) from exc
    network.set_training_mode(False)
    return network


def shapes_of(space: gym.spaces.Dict) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what an agent is given, by name."""
    return {name: cast("tuple[int, ...]", part.shape) for name, part in space.items()}
