"""lerobot's configuration of the plain policies that remember; `docs/general_memory.md` explains them."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from vla_eval.errors import RecipeError, unknown_name
from vla_eval.policies.episode_config import EpisodeConfig
from vla_eval.policies.sequence.sizes import CORES, ENCODERS

TYPE = "mikasa_sequence"


@PreTrainedConfig.register_subclass(TYPE)
@dataclass
class MikasaSequenceConfig(EpisodeConfig):
    """A plain network: an encoder of images, a core over time, a head that predicts a chunk.

    Attributes:
        core: what is kept from step to step, a name of `CORES`.
        encoder: of images, a name of `ENCODERS`.
        width: units of a step's token, of the core and of the head.
        layers: of the core.
        heads: of its attention, where it has any.
        context_steps: the steps, the newest among them, that a layer of a transformer sees.
        dropout: of the core.
    """

    core: str = "gru"
    encoder: str = "keypoints"
    width: int = 256
    layers: int = 1
    heads: int = 4
    context_steps: int = 200
    dropout: float = 0.0

    optimizer_lr: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, known in (("core", CORES), ("encoder", ENCODERS)):
            if getattr(self, name) not in known:
                raise unknown_name(name, getattr(self, name), known, where=f"policy ({TYPE})")
        for name in ("width", "layers", "heads", "context_steps"):
            if getattr(self, name) < 1:
                raise RecipeError(f"{name} is {getattr(self, name)}, expected a number ≥ 1")
        if not 0 <= self.dropout < 1:
            raise RecipeError(f"dropout is {self.dropout}, expected a number in [0, 1)")
        if CORES[self.core].attends and self.width % (2 * self.heads):
            raise RecipeError(
                f"width is {self.width}, expected a multiple of 2 · heads ({2 * self.heads}) for the core "
                f"'{self.core}'"
            )
