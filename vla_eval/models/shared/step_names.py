"""Names of our processor steps in the files of a checkpoint. Knows nothing, not even torch."""

from collections.abc import Mapping
from typing import Literal

ENCODER_STEP, DECODER_STEP = "mikasa_encoder", "mikasa_decoder"

NormalizationKind = Literal["mean_std", "q01_q99"]
STATISTICS: Mapping[NormalizationKind, tuple[str, str]] = {
    "mean_std": ("mean", "std"),
    "q01_q99": ("q01", "q99"),
}
"""Kind of normalisation -> the statistics that it takes."""

EXTREMES: Mapping[NormalizationKind, tuple[str, ...]] = {"mean_std": (), "q01_q99": ("min", "max")}
"""Kind of normalisation -> what is also used where it is known: it shows which dimensions never vary."""
