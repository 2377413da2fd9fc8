"""Octo as one module: transformer and action head, from sizes. Knows only torch."""

from torch import nn

from vla_eval.models.octo.diffusion_head import DiffusionHead, HeadSizes
from vla_eval.models.octo.transformer import OctoTransformer, TransformerSizes


class OctoNetwork(nn.Module):
    """The parts that the original trains; the text encoder, which it never trains, is beside it."""

    def __init__(self, transformer: TransformerSizes, head: HeadSizes) -> None:
        super().__init__()
        self.transformer = OctoTransformer(transformer)
        self.head = DiffusionHead(head)
