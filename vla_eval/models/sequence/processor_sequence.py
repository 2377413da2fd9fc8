"""lerobot looks here for the processors of `mikasa_sequence` by their name."""

from vla_eval.models.shared.plain_processors import (
    make_plain_processors as make_mikasa_sequence_pre_post_processors,  # noqa: F401
)
