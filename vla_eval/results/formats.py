"""The formats of tables, for their writers and for the command line, which must not import statistics."""

from typing import Literal, get_args

Format = Literal["markdown", "csv", "json", "latex", "html-table"]
FORMATS: tuple[Format, ...] = get_args(Format)
ReadableFormat = Literal["markdown", "latex", "html-table"]
FOR_READING: tuple[ReadableFormat, ...] = get_args(ReadableFormat)
Preset = Literal["paper"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
By = Literal["n_action_steps", "policy"]
"""The one setting in which rows that `mikasa-vla compare` compares differ."""
COMPARED_BY: tuple[By, ...] = get_args(By)
