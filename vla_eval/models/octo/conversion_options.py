"""Options for converting an original Octo checkpoint. Without torch."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any  # fields of a configuration

from vla_eval.models.shared.options import gripper_option, option


@dataclass(frozen=True, slots=True, kw_only=True)
class OctoOptions:
    """What the files do not say; flags explain themselves."""

    size: str | None = option(
        None, "--size", choices=("small", "base"), required=True, help="which Octo it is"
    )
    dataset: str | None = option(
        None, "--dataset-name", metavar="NAME", help="whose statistics, where there are several"
    )
    gripper: str | None = gripper_option()
    tokenizer: str | None = option(None, "--tokenizer", metavar="DIR", help="folder of the tokenizer")
    fields: Mapping[str, Any] = field(default_factory=dict)
