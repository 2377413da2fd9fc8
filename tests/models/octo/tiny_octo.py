"""The sizes of a tiny Octo, and where the original's tiny one is kept."""

from pathlib import Path
from typing import Any

from vla_eval.checkpoints import conversion
from vla_eval.models.octo import flax_names
from vla_eval.models.octo.conversion_options import OctoOptions

GOLDEN = Path(__file__).parents[2] / "golden" / "octo"
TINY: dict[str, Any] = {
    **{"image_px": {"primary": 32, "wrist": 16}, "width": 16, "layers": 1, "heads": 2, "mlp_width": 16},
    **{"stem_channels": [32, 32, 32, 32], "stem_features": 8, "head_hidden": 16, "head_blocks": 1},
    **{"language_tokens": 40, "tokenizer_name": "bytes"},
    "t5": {"vocabulary": 260, "width": 8, "key": 4, "heads": 2, "layers": 1, "mlp_width": 8},
}


def convert(source: Path, out: Path, **options: Any) -> Path:
    return conversion.convert("mikasa_octo", source, out, OctoOptions(**options))


def our_name(key: str) -> str:
    rule = flax_names._rule(key)
    assert rule is not None, key
    return rule.name
