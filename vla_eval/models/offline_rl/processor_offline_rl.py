"""lerobot looks here for the processors of `mikasa_offline_rl` by their name."""

from vla_eval.models.shared.plain_processors import (
    make_plain_processors as make_mikasa_offline_rl_pre_post_processors,  # noqa: F401
)
