from vla_eval.models.shared.plain_processors import (
    make_plain_processors as make_mikasa_toy_pre_post_processors,  # noqa: F401  lerobot looks for this name
)
