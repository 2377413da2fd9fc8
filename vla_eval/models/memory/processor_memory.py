"""lerobot looks here for the processors of `mikasa_memory` by their name."""

from vla_eval.models.shared.plain_processors import (
    make_plain_processors as make_mikasa_memory_pre_post_processors,  # noqa: F401
)
