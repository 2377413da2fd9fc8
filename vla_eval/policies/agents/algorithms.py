"""The algorithms, a row each: whose code, and what a recipe may say. Imports the library on first use."""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any  # stable-baselines3's classes, and values of a recipe

from vla_eval.errors import MissingDependencyError, RecipeError, VlaEvalError, check_names
from vla_eval.strict.json_text import WORDS

INSTALL = "Install it with `make rl`, or pip install 'mikasa-vla-eval[rl]'."


_NETWORK_FIELDS = ("net_arch", "activation", "log_std_init", "ortho_init")


@dataclass(frozen=True, slots=True, kw_only=True)
class Algorithm:
    """One algorithm."""

    name: str
    code: str  # `module:Class`
    # the network with several inputs: the library's name for it, or `module:Class`
    network: str
    recipes: Mapping[str, str]  # "robot", "base" -> the recipe that is meant without --policy
    # the argument that says after how many steps per environment weights change; None: a step is a gradient
    # step, and what is learned from is what the scripted expert does
    steps: str | None
    fields: tuple[str, ...] = _NETWORK_FIELDS  # of the network, that a recipe may set
    fits_discrete: bool = True  # it can choose among discrete actions
    replays: bool = False  # it learns from a buffer of earlier steps

    @property
    def imitates(self) -> bool:
        """Whether it learns from demonstrations, not from rewards."""
        return self.steps is None


_ROWS = (
    Algorithm(
        name="ppo",
        code="stable_baselines3:PPO",
        network="MultiInputPolicy",
        recipes={"robot": "ppo", "base": "ppo_base"},
        steps="n_steps",
    ),
    Algorithm(
        name="ppo_lstm",
        code="sb3_contrib:RecurrentPPO",
        network="vla_eval.policies.agents.lstm:WholeSequences",
        recipes={"robot": "ppo_lstm", "base": "ppo_lstm_base"},
        steps="n_steps",
        fields=(
            *_NETWORK_FIELDS,
            *("lstm_hidden_size", "n_lstm_layers", "shared_lstm", "enable_critic_lstm", "lstm_forget_bias"),
        ),
    ),
    Algorithm(
        name="sac",
        code="stable_baselines3:SAC",
        network="MultiInputPolicy",
        recipes={"robot": "sac", "base": "sac"},
        steps="train_freq",
        fits_discrete=False,
        replays=True,
    ),
    Algorithm(
        name="imitation",
        code="vla_eval.agents.imitation:Imitation",
        network="vla_eval.policies.agents.imitator:CoreNetwork",
        recipes={"robot": "imitation", "base": "imitation_base"},
        steps=None,
        fields=("core", "width", "layers", "heads", "context_steps", "dropout", "core_options"),
    ),
)
ALGORITHMS: Mapping[str, Algorithm] = {row.name: row for row in _ROWS}

LEFT_OUT = {
    "tdmpc2": "no package has it: the authors' code is not one, and torchrl 0.14.1, the newest, has none "
    "(its development branch has). This harness has no algorithms of its own.",
}
"""Algorithms of the paper that are not here, and why."""

OWN = frozenset(
    {"policy", "env", "policy_kwargs", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
)
"""Arguments of the library's classes that the training sets itself."""
_ACTIVATIONS = ("tanh", "relu", "elu", "gelu")


def algorithm(name: str) -> Algorithm:
    """Return the row of an algorithm."""
    if name in LEFT_OUT:
        raise RecipeError(f"algorithm '{name}': {LEFT_OUT[name]}")
    check_names("algorithm", [name], ALGORITHMS)
    return ALGORITHMS[name]


def library_class(row: Algorithm) -> Any:
    """Return the class of an algorithm."""
    return _imported(row, row.code)


def network_class(row: Algorithm) -> Any:
    """Return the class of an algorithm's network."""
    if ":" in row.network:
        return _imported(row, row.network)
    return library_class(row).policy_aliases[row.network]


def _imported(row: Algorithm, target: str) -> Any:
    module, _, name = target.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as exc:
        if exc.name is None or exc.name.partition(".")[0] not in ("stable_baselines3", "sb3_contrib"):
            raise
        raise MissingDependencyError(
            f"algorithm '{row.name}' needs the package '{exc.name}', which is not installed. {INSTALL}"
        ) from exc


def steps_per_update(row: Algorithm, arguments: Mapping[str, Any], *, n_envs: int) -> int:
    """Return after how many steps of all environments together the weights change."""
    if row.steps is None:
        return 1
    found = arguments.get(row.steps)
    if found is None:
        found = inspect.signature(library_class(row).__init__).parameters[row.steps].default
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        raise RecipeError(
            f"train_agent.arguments.{row.steps} is {found!r}, expected a whole number of steps, 1 or more."
        )
    return n_envs * found


def check_arguments(row: Algorithm, arguments: Mapping[str, Any]) -> None:
    """Refuse what is no argument of the library's class, none that a recipe may give, or of another kind."""
    parameters = inspect.signature(library_class(row).__init__).parameters
    known = set(parameters) - OWN - {"self"}
    check_names("field", arguments, sorted(known), where="train_agent.arguments")
    for name, value in arguments.items():
        kinds = _kinds(parameters[name].default)
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            words = " or ".join(WORDS[kind] for kind in kinds)
            raise RecipeError(f"train_agent.arguments.{name} is {value!r}, expected {words}.")


def _kinds(default: object) -> tuple[type, ...]:
    """Return the types that may stand in place of a default: a word such as `auto` may be a number, too."""
    if isinstance(default, bool):
        return (bool,)
    if isinstance(default, str):
        return (str, int, float)
    if default is None:
        return (int, float, bool, type(None))
    return (int, float)


def network_fields(row: Algorithm, network: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a network as the library takes them."""
    import torch

    check_names("field", network, row.fields, where="train_agent.network")
    fields = dict(network)
    activation = fields.pop("activation", None)
    if activation is not None:
        check_names("activation", [str(activation)], _ACTIVATIONS, where="train_agent.network.activation")
        named = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "elu": torch.nn.ELU, "gelu": torch.nn.GELU}
        fields["activation_fn"] = named[activation]
    return fields


def asked_of_library[T](make: Callable[[], T], *, where: str) -> T:
    """Return what the library makes; what it refuses becomes one message."""
    try:
        return make()
    except VlaEvalError:
        raise
    except (TypeError, ValueError, AssertionError) as exc:  # by these it says what it does not take
        raise RecipeError(f"{where}: the library refuses it ({' '.join(str(exc).split()):.300}).") from exc
