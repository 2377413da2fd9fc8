"""The action tokenizer of π0-FAST, read as data; lerobot would run the Python code that lies beside it.

Actions become the coefficients of a discrete cosine transform over time, rounded; each coefficient is a
character, and a byte-pair encoding makes tokens of the string (Pertsch et al. 2025, arXiv 2501.09747). Files:
`processor_config.json` (`scale`, `min_token`) and a tokenizer of transformers.
"""

import json
from pathlib import Path
from typing import Any  # transformers is untyped

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import dct
from transformers import PreTrainedTokenizerFast
from transformers.utils import cached_file

from vla_eval.errors import CheckpointError
from vla_eval.strict.json_fields import read_json

SETTINGS_FILE = "processor_config.json"
VOCABULARY_FOLDER = "bpe_tokenizer"
"""Where processors of transformers keep it; that of physical-intelligence/fast lies beside the settings."""
CLASS = "UniversalActionProcessor"
"""What the published tokenizers call this scheme; another name is another scheme."""


class FastActionTokenizer:
    """Tokens of normalised actions; coefficients below `min_token`, the first character, become it."""

    def __init__(self, bpe_tokenizer: Any, *, scale: float, min_token: int) -> None:
        self.bpe_tokenizer, self.scale, self.min_token = bpe_tokenizer, scale, min_token

    def __call__(self, actions: ArrayLike) -> list[list[int]]:
        """Return the tokens of each chunk of normalised actions (B, T, action)."""
        # The stubs of scipy know lists of one number only.
        coefficients: Any = dct(np.asarray(actions, dtype=np.float64), axis=1, norm="ortho")
        characters = np.maximum(np.around(coefficients * self.scale) - self.min_token, 0).astype(int)
        strings = ("".join(map(chr, chunk.ravel())) for chunk in characters)
        return [list(self.bpe_tokenizer(string)["input_ids"]) for string in strings]

    def save_pretrained(self, folder: Path) -> None:
        """Write the files that `load_fast_tokenizer` reads."""
        self.bpe_tokenizer.save_pretrained(str(folder))
        settings = {"processor_class": CLASS, "scale": self.scale, "min_token": self.min_token}
        (folder / SETTINGS_FILE).write_text(json.dumps(settings, indent=2), encoding="utf-8")


def load_fast_tokenizer(name: str) -> FastActionTokenizer:
    """Read a tokenizer of this scheme from a folder, or from the local cache by its published name."""
    try:
        file = Path(str(cached_file(name, SETTINGS_FILE)))
        settings = read_json(file)
        loaded = _vocabulary(name)
    except (OSError, ValueError) as exc:
        raise CheckpointError(
            f"the action tokenizer '{name}' cannot be read: {exc} Fetch its folder, and name it by "
            "policy.action_tokenizer_name; nothing is downloaded unless HF_HUB_OFFLINE=0 is set."
        ) from exc
    found = settings.get("processor_class")
    if found != CLASS:
        raise CheckpointError(
            f"the action tokenizer '{name}' is a '{found}'; expected a '{CLASS}', the only one that is read "
            "here as data. Code that comes with a tokenizer is not run."
        )
    scale, min_token = settings.get("scale"), settings.get("min_token")
    has_truth_value = isinstance(scale, bool) or isinstance(min_token, bool)
    if has_truth_value or not isinstance(scale, int | float) or not isinstance(min_token, int):
        raise CheckpointError(
            f"{file}: expected numbers 'scale' and 'min_token', found {scale!r:.60} and {min_token!r:.60}. "
            "Fetch the action tokenizer again."
        )
    return FastActionTokenizer(loaded, scale=float(scale), min_token=min_token)


def _vocabulary(name: str) -> Any:
    """Return the byte-pair encoding, which lies beside the settings, or in `VOCABULARY_FOLDER`."""
    try:
        return PreTrainedTokenizerFast.from_pretrained(name)
    except (OSError, ValueError) as beside:
        try:
            return PreTrainedTokenizerFast.from_pretrained(name, subfolder=VOCABULARY_FOLDER)
        except (OSError, ValueError):
            raise beside from None


class FastProcessors:
    """Stands where lerobot has `transformers.AutoProcessor` for the action tokenizer."""

    @staticmethod
    def from_pretrained(name: str, *, trust_remote_code: bool = False) -> FastActionTokenizer:
        """Return the tokenizer; no code is run, trusted or not."""
        return load_fast_tokenizer(name)
