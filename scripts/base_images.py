"""Draw the film strips of the pages on MIKASA-Base: six moments of an episode of the oracle, per family.

Usage: .venv/bin/python scripts/base_images.py [FAMILY…]        (after `make base`)
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vla_eval.base_tasks.catalog import BASE_TASKS
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.players.play import player_of

FOLDER = Path(__file__).parents[1] / "docs" / "images" / "base"
N_MOMENTS, HEIGHT_PX, GAP_PX, N_COLORS = 6, 150, 4, 48
SEED = 1


def main(families: Sequence[str]) -> None:
    """Write a frame per family, of its first level."""
    first = {row.family: row.name for row in reversed(BASE_TASKS.values())}
    FOLDER.mkdir(exist_ok=True)
    for family in families or first:
        path = FOLDER / f"{family}.png"
        strip(first[family]).save(path, optimize=True)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def strip(name: str) -> Image.Image:
    """Return moments of an episode side by side, the reset first and the end last."""
    frames = _frames(name)
    chosen = [frames[int(index)] for index in np.linspace(0, len(frames) - 1, min(N_MOMENTS, len(frames)))]
    scaled = [_scaled(frame) for frame in chosen]
    gap = np.full((HEIGHT_PX, GAP_PX, 3), 255, np.uint8)
    columns = [column for frame in scaled for column in (frame, gap)][:-1]
    return Image.fromarray(np.concatenate(columns, axis=1)).quantize(N_COLORS)


def _frames(name: str) -> list[NDArray[np.uint8]]:
    env = make_base_task(name, render_mode="rgb_array")
    player = player_of(name, "oracle", env.action_space)
    observation, _ = env.reset(seed=SEED)
    player.begin(np.random.default_rng([SEED, 7]))
    frames, is_over = [env.render()], False
    while not is_over:
        observation, _, terminated, truncated, _ = env.step(player.act(observation, env.true_state()))
        frames.append(env.render())
        is_over = terminated or truncated
    env.close()
    return [frame for frame in frames if frame is not None]


def _scaled(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width, _ = frame.shape
    image = Image.fromarray(frame).resize(
        (round(width * HEIGHT_PX / height), HEIGHT_PX), Image.Resampling.BOX
    )
    return np.asarray(image)


if __name__ == "__main__":
    main(sys.argv[1:])
