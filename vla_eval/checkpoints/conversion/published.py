"""Convert the published bases as recipes expect them: the options that their files do not state."""

from pathlib import Path

from vla_eval.checkpoints.bases import Converter
from vla_eval.checkpoints.conversion import octo, openvla, spatialvla

OPEN_X_GRIPPER = "unit_open"  # of Open X-Embodiment, on which all of them were trained
OCTO_STATISTICS = "bridge_dataset"  # any of those it has: a fine-tuning replaces them


def convert_published(converter: Converter, source: Path, out: Path) -> Path:
    """Write the LeRobot checkpoint `out`; return it.

    Args:
        converter: which.
        source: the fetched files; of Octo with T5's tokenizer in `tokenizer/`.
        out: a folder that is not there yet.

    Raises:
        CheckpointError: something is missing, or not of this model.
    """
    match converter:
        case "octo-small" | "octo-base":
            return octo.convert(
                source,
                out,
                fields=octo.SIZES["small" if converter == "octo-small" else "base"],
                gripper=OPEN_X_GRIPPER,
                dataset=OCTO_STATISTICS,
                tokenizer=str(source / "tokenizer"),
            )
        case "openvla":
            options = openvla.ConvertOptions(gripper=OPEN_X_GRIPPER, image_augmentation=False)
            return openvla.convert_openvla(source, out, options)
        case "spatialvla":
            return spatialvla.convert_spatialvla(source, out, spatialvla.ConvertOptions())
