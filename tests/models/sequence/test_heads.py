"""Heads of the sequence policies: a flow learns chunks, and what is decided stays as it is."""

import functools

import pytest
import torch
from lerobot.configs import RTCAttentionSchedule
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

from vla_eval.models.sequence.heads import FlowHead, PrefixReader
from vla_eval.models.shared.prefix import Prefix, drawn_lengths, prefix_of

WIDTH, CHUNK, DIMS = 16, 6, 2


def demonstrations() -> tuple[Tensor, Tensor]:
    """Return what was decided, (4, width), and the chunks (4, chunk, dims) of it: straight lines."""
    decided = torch.eye(4, WIDTH)
    slopes = torch.tensor([[0.1, 0.0], [-0.1, 0.05], [0.0, -0.1], [0.05, 0.1]])
    return decided, slopes[:, None] * torch.arange(1, CHUNK + 1)[:, None]


@functools.cache
@torch.enable_grad()
def trained(prefix_steps: int = 0) -> FlowHead:
    torch.manual_seed(0)
    head = FlowHead(WIDTH, (CHUNK, DIMS))
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    decided, actions = (values.repeat(16, *[1] * (values.dim() - 1)) for values in demonstrations())
    for _ in range(400):
        prefix = prefix_of(actions, drawn_lengths(actions, prefix_steps)) if prefix_steps else None
        errors = head.errors(decided, actions, prefix)
        loss = errors.mean() if prefix is None else (errors * ~prefix.mask).sum() / (~prefix.mask).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return head.eval()


def noise(seed: int = 1) -> Tensor:
    return torch.randn(4, CHUNK, DIMS, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def test_a_flow_makes_the_chunk_that_goes_with_what_was_decided() -> None:
    decided, actions = demonstrations()

    made = trained().sample(decided, noise(), 10)

    assert (made - actions).abs().mean() < 0.05  # the chunks differ by 0.5 on average
    assert (made - actions.roll(1, dims=0)).abs().mean() > 0.2


@torch.no_grad()
def test_integration_follows_straight_lines_from_noise_at_1_to_actions_at_0() -> None:
    """With the true velocity, noise - actions, any number of steps ends at the actions."""
    head = FlowHead(WIDTH, (CHUNK, DIMS))
    decided, actions = demonstrations()
    start = noise()
    head.forward = lambda noisy, times, _: start - actions  # type: ignore[method-assign]

    for n_steps in (1, 7):
        torch.testing.assert_close(head.sample(decided, start, n_steps), actions, atol=1e-5, rtol=1e-5)


class TestPrefix:
    @pytest.mark.parametrize("n_rows", [1, 3, 5])
    @torch.no_grad()
    def test_the_rows_of_a_prefix_are_in_the_chunk_as_they_are(self, n_rows: int) -> None:
        decided, actions = demonstrations()
        mask = (torch.arange(CHUNK) < n_rows).expand(4, -1)

        made = trained(4).sample(decided, noise(), 10, prefix=Prefix(actions, mask))

        assert torch.equal(made[:, :n_rows], actions[:, :n_rows])
        assert not torch.equal(made[:, n_rows:], actions[:, n_rows:])

    @torch.no_grad()
    def test_what_follows_depends_on_the_prefix_and_not_on_what_lies_beyond_it(self) -> None:
        decided, actions = demonstrations()
        mask = (torch.arange(CHUNK) < 2).expand(4, -1)
        beyond = actions.clone()
        beyond[:, 2:] = 9.0

        one, same, other = (
            trained(4).sample(decided, noise(), 10, prefix=Prefix(given, mask))
            for given in (actions, beyond, -actions)
        )
        assert torch.equal(one, same)
        assert (one[:, 2:] - other[:, 2:]).abs().max() > 1e-3

    def test_lengths_are_drawn_from_none_to_the_most_alike(self) -> None:
        torch.manual_seed(0)
        prefix = prefix_of(chunks := torch.zeros(3000, CHUNK, DIMS), drawn_lengths(chunks, 3))
        lengths = prefix.mask.sum(dim=1)

        assert (prefix.mask == (torch.arange(CHUNK) < lengths[:, None])).all()  # from the first row on
        counts = torch.bincount(lengths, minlength=4)
        assert ((counts / 3000 - 0.25).abs() < 0.04).all()  # five standard deviations

    def test_a_head_that_makes_chunks_at_once_reads_what_is_decided_and_no_more(self) -> None:
        torch.manual_seed(0)
        head = PrefixReader(WIDTH, (CHUNK, DIMS), prefix_steps=3)
        decided, actions = demonstrations()
        mask = (torch.arange(CHUNK) < 2).expand(4, -1)
        beyond = actions.clone()
        beyond[:, 2:] = 9.0

        one = head(decided, Prefix(actions, mask))
        assert torch.equal(one, head(decided, Prefix(beyond, mask)))
        assert not torch.equal(one, head(decided, Prefix(actions + 1, mask)))
        assert torch.equal(head(decided, None), head(decided, Prefix(actions, mask & False)))


class TestGuidance:
    def guided(
        self, schedule: str, *, delay: int, left: Tensor, weight: float = 10.0, horizon: int = CHUNK
    ) -> Tensor:
        processor = RTCProcessor(
            RTCConfig(
                prefix_attention_schedule=RTCAttentionSchedule(schedule),
                max_guidance_weight=weight,
                execution_horizon=horizon,
            )
        )
        decided, _ = demonstrations()
        integrate = functools.partial(
            euler_integrate,
            rtc_processor=processor,
            rtc_enabled=True,
            inference_delay=delay,
            prev_chunk_left_over=left,
        )
        with torch.no_grad():
            return trained().sample(decided, noise(), 10, integrate=integrate)

    def test_with_weights_of_zero_it_is_unguided_denoising_bit_for_bit(self) -> None:
        decided, actions = demonstrations()
        with torch.no_grad():
            plain = trained().sample(decided, noise(), 10)

        assert torch.equal(self.guided("ZEROS", delay=0, left=actions + 0.3), plain)
        assert not torch.equal(self.guided("ZEROS", delay=1, left=actions + 0.3), plain)

    @pytest.mark.parametrize("schedule", ["ZEROS", "ONES", "LINEAR", "EXP"])
    def test_guided_chunks_are_nearer_to_what_is_committed(self, schedule: str) -> None:
        decided, actions = demonstrations()
        left = actions[:, :4] + 0.3
        with torch.no_grad():
            plain = trained().sample(decided, noise(), 10)
        made = self.guided(schedule, delay=2, left=left, horizon=4)

        before, after = ((chunk[:, :2] - left[:, :2]).abs().mean(dim=(1, 2)) for chunk in (plain, made))
        assert (after < before).all()
