"""LeRobot's guidance of a denoising, which chunks are joined by, against the formulas of its paper.

Source: Black, Galliker, Levine, "Real-Time Execution of Action Chunking Flow Policies" (2025), equations 2 to
5, with time running from 1 to 0 as in LeRobot, and without the Jacobian of the network, which LeRobot leaves
out (docs/real_time.md).
"""

import functools
import math

import numpy as np
import pytest
import torch
from lerobot.configs.types import RTCAttentionSchedule
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from numpy.typing import NDArray

CHUNK, N_DIMS, N_STEPS = 8, 3, 10
Numbers = NDArray[np.float64]


def paper_weights(schedule: str, *, frozen: int, horizon: int) -> Numbers:
    """Equation 5: 1 up to the delay, falling to 0 at the execution horizon."""
    weights = np.zeros(CHUNK)
    for i in range(CHUNK):
        falling = (horizon - i) / (horizon - frozen + 1)
        if i < frozen:
            weights[i] = 1
        elif i < horizon:
            weights[i] = {
                "zeros": 0,
                "ones": 1,
                "linear": falling,
                "exp": falling * (math.exp(falling) - 1) / (math.e - 1),
            }[schedule]
    return weights


def denoised(schedule: str, *, frozen: int, horizon: int, most: float) -> Numbers:
    """Ten Euler steps of the flow towards one chunk, guided by the formulas."""
    noise, goal, before = chunks()
    weights = paper_weights(schedule, frozen=frozen, horizon=min(horizon, len(before)))[:, None]
    kept = np.zeros_like(noise)
    kept[: len(before)] = before
    x = noise
    for step in range(N_STEPS):
        time = 1 - step / N_STEPS
        velocity = (x - goal) / time
        error = (kept - (x - time * velocity)) * weights
        done = 1 - time
        r_squared = time**2 / (done**2 + time**2)
        guidance = min(most, time / done / r_squared) if done > 0 else most
        x = x - (velocity - guidance * error) / N_STEPS
    return x


def chunks() -> tuple[Numbers, Numbers, Numbers]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(CHUNK, N_DIMS)), rng.normal(size=(CHUNK, N_DIMS)), rng.normal(size=(6, N_DIMS))


@pytest.mark.parametrize("schedule", ["zeros", "ones", "linear", "exp"])
@pytest.mark.parametrize(
    ("frozen", "horizon", "most"), [(0, 5, 10.0), (2, 5, 10.0), (2, 8, 1.0), (6, 6, 5.0)]
)
def test_it_is_that_of_the_paper(schedule: str, frozen: int, horizon: int, most: float) -> None:
    config = RTCConfig(
        prefix_attention_schedule=RTCAttentionSchedule(schedule.upper()),
        max_guidance_weight=most,
        execution_horizon=horizon,
    )
    processor = RTCProcessor(config)
    noise, goal, before = (torch.tensor(one[None], dtype=torch.float32) for one in chunks())
    x = noise
    for step in range(N_STEPS):
        time = 1 - step / N_STEPS
        flow = functools.partial(lambda at, time: (at - goal) / time, time=time)
        velocity = processor.denoise_step(x, before, frozen, time, flow, execution_horizon=horizon)
        x = x - velocity / N_STEPS
    expected = denoised(schedule, frozen=frozen, horizon=horizon, most=most)
    np.testing.assert_allclose(x[0].numpy(), expected, atol=2e-5)


def test_ten_steps_do_not_reproduce_what_is_frozen() -> None:
    """Of a perfect flow, which without guidance ends at its goal; larger weights change little."""
    _, goal, before = chunks()
    apart = np.abs(goal[:2] - before[:2])
    for most in (10.0, 100.0):
        left = np.abs(denoised("exp", frozen=2, horizon=5, most=most)[:2] - before[:2]) / apart
        assert left == pytest.approx(0.089, abs=0.001)
