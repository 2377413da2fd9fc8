"""The sizes of a tiny Octo, and where the original's tiny one is kept."""

from pathlib import Path
from typing import Any

GOLDEN = Path(__file__).parents[2] / "golden" / "octo"
TINY: dict[str, Any] = {
    **{"image_px": {"primary": 32, "wrist": 16}, "width": 16, "layers": 1, "heads": 2, "mlp_width": 16},
    **{"stem_channels": [32, 32, 32, 32], "stem_features": 8, "head_hidden": 16, "head_blocks": 1},
    **{"language_tokens": 40, "tokenizer_name": "bytes"},
    "t5": {"vocabulary": 260, "width": 8, "key": 4, "heads": 2, "layers": 1, "mlp_width": 8},
}
