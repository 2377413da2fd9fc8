"""Names of encoders, tokens and heads of a plain policy, and what has to be known of them. Without torch."""

from vla_eval.models.shared.stages import VISION, Stage, Stages

ENCODERS = {"keypoints": False, "color_keypoints": False, "nature": False, "nature_stacked": True}
"""Name -> whether one is shared by all cameras, whose images are its channels."""
NATURE_LAYERS = ((8, 4), (4, 2), (3, 1))
"""Kernel and stride of the convolutions of `nature`, in pixels: Mnih et al. 2015."""


def nature_edges(image_px: int) -> tuple[int, ...]:
    """Return the edges of what these convolutions make of an image, in places."""
    edges, edge = [], image_px
    for kernel, stride in NATURE_LAYERS:
        edge = (edge - kernel) // stride + 1
        edges.append(edge)
    return tuple(edges)


def encoder_stages(image_px: int, n_images: int, *, nature: bool) -> Stages:
    """Return the places of an image encoder: `nature`, or keypoints, which read cells of 4 x 4 pixels."""
    encoder = r"network\.(?:encoder|encoders\.\d+)\."
    if not nature:
        places = Stage(encoder + r"features\.", n_images * (image_px // 4) ** 2, VISION)
        return (places, Stage(encoder + "reads", n_images, VISION))
    edges = enumerate(nature_edges(image_px))  # a layer of rectified units follows each convolution
    return (
        *(Stage(encoder + rf"{2 * index}\b", n_images * edge**2, VISION) for index, edge in edges),
        Stage(encoder + r"7\b", n_images, VISION),
    )


TOKENS = {"step": 1, "return_observation": 2, "return_observation_action": 3}
"""How many a step has: the observation; with the return to go before it; with the action after it, too."""
HEADS = ("gated", "linear", "flow")
N_FLOW_LAYERS = 3
FLOW_TIME = {"alpha": 1.5, "beta": 1.0, "scale": 0.999, "offset": 0.001}
"""How times are drawn in training: π0's, Black et al. 2024 (arXiv:2410.24164), appendix B; as in LeRobot."""
