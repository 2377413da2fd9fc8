"""What a row of `families` may say. Standard library only: planning must not wait for torch."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal  # Any: fields of a configuration, and what a row names

LEROBOT = "lerobot"
"""The adapter of LeRobot's policies."""
Noise = Literal["flow", "ddim"]
"""What an inference draws and can be given: `flow`: a chunk of actions as wide as the model's; `ddim`: the
horizon of a diffusion policy whose scheduler draws nothing further."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Files of a repository of the Hub."""

    repo_id: str  # `OWNER/NAME`
    revision: str | None  # the commit that is fetched; None: the newest, which is noted beside the files
    patterns: tuple[str, ...]  # names of the files, as shells match them
    folder: str = ""  # where they lie below the folder that is fetched; empty: in it


@dataclass(frozen=True, slots=True, kw_only=True)
class Base:
    """A published checkpoint."""

    name: str  # of its folder in `checkpoints/`, as recipes name it
    title: str  # for people
    terms: str  # the licence, as its authors state it; the Hub's own statement is shown, too
    # what is fetched, small parts first: one that is refused is then known before the large ones
    parts: tuple[Source, ...]
    # of its family's converter, which makes a LeRobot checkpoint of the files; `{source}` is their
    # folder. None: they are one.
    options: Mapping[str, Any] | None = None
    # of its configuration, where they are not the defaults of its type
    fields: Mapping[str, Any] = field(default_factory=dict)
    # the files are not a checkpoint, but weights of a part of a policy; the name is torchvision's
    is_backbone: bool = False

    @property
    def weights(self) -> Source:
        """What holds the weights."""
        return self.parts[-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tiny:
    """The form of a family in a table of tiny models."""

    # in `policies/`; empty: the row's own recipe, or, of a family with `built_tiny`, none
    recipe: str = ""
    # of the configuration that differ from the recipe's
    fields: Mapping[str, Any] = field(default_factory=dict)
    # the chunk is as long as the row executes; False: it follows from other fields
    sets_chunk: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """A type of LeRobot policy. What is named as `module:attribute` is imported when it is used."""

    type: str  # lerobot's name of it
    configuration: str = ""  # the module that registers it; empty: lerobot does
    wraps: str = ""  # lerobot's type to which ours adds something; the row is then a copy of that one's
    docs: str = ""  # page that explains it
    # its constructor does not compute with its weights: it is built without memory for them
    is_built_empty: bool = False
    # `module:name` in lerobot -> `module:attribute` that stands there while a policy is loaded, where
    # lerobot would run code that comes with a checkpoint
    replaces: Mapping[str, str] = field(default_factory=dict)
    draws_nothing: bool = False  # it draws nothing at inference
    # what `reset` empties, of a type whose `predict_action_chunk` reads the frames that its own
    # `select_action` collected. It is asked for one action at a time (`select_step`).
    queues: tuple[str, ...] = ()
    # why it can be asked neither for a chunk nor for a step of one of several episodes
    why_not: str = ""
    # what is compiled where `compile` asks for it: functions of the policy, as `attribute.attribute`
    compiled: tuple[str, ...] = ("predict_action_chunk",)
    not_compiled: str = ""  # why it is not
    # its embeddings of patches, as `attribute.attribute`, whose positions torch cannot trace
    traced_positions: str = ""
    cuts_chunk: bool = False  # its `predict_action_chunk` returns `n_action_steps` actions and no more
    noise: Noise | None = None  # what it can be given in place of its own draws
    lora_targets: str | None = None  # modules that get an adapter, where lerobot's own choice is wrong
    # function from a configuration to the `Stage`s of its network; empty: they are not known
    stages: str = ""
    # numbers that a layer keeps for the backward pass (`training.cost.sample_cost`)
    saved_per_linear: float = 1.3
    counts_all_layers: bool = False  # convolutions and attention are counted like linear layers
    bases: tuple[Base, ...] = ()  # published checkpoints that recipes start from
    # function `(source, options)` that makes an `Original` of a published checkpoint
    converter: str = ""
    convert_options: str = ""  # the class of its options, whose fields are also the verb's flags
    adapter: str = LEROBOT  # what runs a checkpoint of it that is named by its folder
    # further adapters of its checkpoints: name -> `module:attribute`, see `policies.registry`
    adapters: Mapping[str, str] = field(default_factory=dict)
    tiny: Tiny | None = None  # its form in a table of tiny models; None: there is none
    built_tiny: str = ""  # context `(type)` in which lerobot builds it tiny
    # function `(folder, tiny)` that makes what its configuration names, without a network
    stand_in: str = ""
    # of the configuration, without a published tokenizer
    stand_in_fields: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Its type as commands call it."""
        return self.type.removeprefix("mikasa_")

    @property
    def lerobot_type(self) -> str:
        """Its type, or lerobot's where ours adds something to it."""
        return self.wraps or self.type


def imported(target: str) -> Any:
    """Return what a row names as `module:attribute`."""
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
