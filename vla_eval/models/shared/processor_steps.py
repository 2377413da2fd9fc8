"""Normalisation and gripper as steps of lerobot's pipelines, with mask and clipping, which it lacks."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any  # lerobot is untyped

import torch
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import IdentityProcessorStep, ProcessorStep, ProcessorStepRegistry
from torch import Tensor

from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.features import ACTION_KEY
from vla_eval.models.shared.gripper import Gripper
from vla_eval.models.shared.normalization import Normalization, Normalizer
from vla_eval.models.shared.step_names import DECODER_STEP, ENCODER_STEP, STATISTICS
from vla_eval.strict.decoding import decode


@dataclass
class _Statistics(ProcessorStep):  # type: ignore[misc]  # lerobot is untyped
    """Specification and statistics of normalised fields; statistics may come with `load_state_dict`."""

    fields: dict[str, Normalization]
    gripper: Gripper = field(default_factory=Gripper)
    stats: dict[str, dict[str, Any]] | None = None
    _normalizers: dict[str, Normalizer] = field(default_factory=dict, init=False, repr=False)
    transform_features = IdentityProcessorStep.transform_features

    def __post_init__(self) -> None:
        """Accept what JSON made of the specifications; keep only the statistics that are used."""
        self.fields = {
            key: spec if isinstance(spec, Normalization) else decode(Normalization, spec, where=key)
            for key, spec in self.fields.items()
        }
        given: Any = self.gripper  # a mapping, where it comes from JSON
        self.gripper = given if isinstance(given, Gripper) else decode(Gripper, given, where="gripper")
        check_gripper_mask(self.fields.get(ACTION_KEY), self.gripper)
        self._given = bool(self.stats)
        if self.stats:
            self._use(self.stats)

    def missing_statistics(self) -> list[str]:
        """Return `field.statistic` of all that is needed and not there."""
        return [
            f"{key}.{name}"
            for key, spec in self.fields.items()
            for name in STATISTICS[spec.kind]
            if key not in self._normalizers
        ]

    def get_config(self) -> dict[str, Any]:
        """Return what JSON can hold; the statistics are in the state."""
        return {
            "fields": {key: dataclasses.asdict(spec) for key, spec in self.fields.items()},
            "gripper": dataclasses.asdict(self.gripper),
        }

    def state_dict(self) -> dict[str, Tensor]:
        return {
            f"{key}/{name}": values
            for key, normalizer in self._normalizers.items()
            for name, values in normalizer.statistics.items()
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take the checkpoint's statistics, unless others were given on purpose."""
        if self._given:
            return
        stats: dict[str, dict[str, Any]] = {}
        for flat, values in state.items():
            key, _, name = flat.rpartition("/")
            stats.setdefault(key, {})[name] = values
        self._use(stats)

    def _use(self, stats: Mapping[str, Mapping[str, Any]]) -> None:
        for key, spec in self.fields.items():
            if key not in stats:
                raise CheckpointError(
                    f"there are no statistics of '{key}', which this policy normalises (found: "
                    f"{', '.join(stats) or 'none'}). Fine-tune on a dataset that has them."
                )
            self._normalizers[key] = Normalizer(spec, stats[key], where=f"statistics of {key}")
        self.stats = {key: normalizer.statistics for key, normalizer in self._normalizers.items()}

    def _normalizer(self, key: str) -> Normalizer:
        missing = self.missing_statistics()
        if missing:
            raise CheckpointError(f"the processor has no statistics for {', '.join(missing)}.")
        return self._normalizers[key]


@dataclass
@ProcessorStepRegistry.register(name=ENCODER_STEP)
class EncoderStep(_Statistics):
    """Before the policy: encodes the gripper of training targets, then normalises all fields."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with its fields normalised; fields it does not have are left out."""
        changed = transition.copy()
        observation = dict(changed.get(TransitionKey.OBSERVATION) or {})
        for key in self.fields:
            if key in observation:
                observation[key] = self._normalizer(key).normalize(observation[key])
        changed[TransitionKey.OBSERVATION] = observation
        action = changed.get(TransitionKey.ACTION)
        if isinstance(action, Tensor):
            encoded = self.gripper.encode(action)
            normalized = ACTION_KEY in self.fields
            changed[TransitionKey.ACTION] = (
                self._normalizer(ACTION_KEY).normalize(encoded) if normalized else encoded
            )
        return changed


@dataclass
@ProcessorStepRegistry.register(name=DECODER_STEP)
class DecoderStep(_Statistics):
    """After the policy: brings predicted actions into the environment's unit and gripper."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with the action (…, A) as the environment takes it."""
        changed = transition.copy()
        action = changed.get(TransitionKey.ACTION)
        if not isinstance(action, Tensor):
            raise CheckpointError(f"expected a tensor of actions, found {type(action).__name__}.")
        if ACTION_KEY in self.fields:
            action = self._normalizer(ACTION_KEY).unnormalize(action)
        changed[TransitionKey.ACTION] = self.gripper.decode(action.to(torch.float32))
        return changed


def check_gripper_mask(action: Normalization | None, gripper: Gripper) -> None:
    """Raise `RecipeError` if a gripper is normalised that is not ManiSkill's, which the statistics are of."""
    if action is not None and action.mask[gripper.dim] and gripper.encoding != "maniskill":
        raise RecipeError(
            f"the gripper is encoded as '{gripper.encoding}' and normalised with statistics of ManiSkill's "
            f"number. Leave its dimension ({gripper.dim}) out of normalization.mask."
        )
