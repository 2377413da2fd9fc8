"""SmolVLA, π0 and π0.5 with memory beside lerobot's own, tiny and random."""

import itertools
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.models.vla_memory.tiny_vlas import BASE, FAMILIES, batch_of, loss_of, made, noise_of
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.models.shared.earlier_frames import SEGMENT_PADDING_KEY, mask_field

N_TOKENS = 3
FRAMES = {"memory_places": 2}
TOKENS = {"memory_tokens": N_TOKENS, "token_stride": 2, "token_segments": 2, "window_steps": 7}


def act(policy: Any, batch: dict[str, Any], **extra: Any) -> torch.Tensor:
    n = len(batch[BASE])
    actions: torch.Tensor = policy.predict_action_chunk(dict(batch), noise=noise_of(policy, n), **extra)
    return actions


@pytest.mark.parametrize("family", FAMILIES)
class TestBesideLerobot:
    def test_without_memory_outputs_and_loss_are_lerobots_bit_for_bit(
        self, family: str, tmp_path: Path
    ) -> None:
        theirs, ours = made(family, tmp_path), made(f"mikasa_{family}", tmp_path)
        ours.load_state_dict(theirs.state_dict())  # strict: the same names
        batch = batch_of(2)
        assert torch.equal(act(ours, batch), act(theirs, batch))
        assert torch.equal(loss_of(ours, dict(batch)), loss_of(theirs, dict(batch)))

    def test_a_masked_place_is_as_if_it_were_not_there(self, family: str, tmp_path: Path) -> None:
        theirs, ours = made(family, tmp_path), made(f"mikasa_{family}", tmp_path, **FRAMES)
        ours.load_state_dict(theirs.state_dict())
        batch = batch_of(2, policy=ours)
        alone = batch_of(2)
        for key in ours.config.memory_fields:
            batch[mask_field(key)] = torch.zeros(2, dtype=torch.bool)
        actions = act(ours, batch)
        torch.testing.assert_close(actions, act(theirs, alone), atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(loss_of(ours, dict(batch)), loss_of(theirs, alone), atol=1e-5, rtol=1e-5)
        others = {**batch, **{key: 1 - batch[key] for key in ours.config.memory_fields}}
        torch.testing.assert_close(act(ours, others), actions, atol=1e-6, rtol=1e-6)

    def test_a_place_is_seen_by_the_samples_that_have_a_frame_in_it(
        self, family: str, tmp_path: Path
    ) -> None:
        policy = made(f"mikasa_{family}", tmp_path, **FRAMES)
        batch = batch_of(2, policy=policy)
        key = policy.config.memory_fields[0]
        batch[mask_field(key)] = torch.tensor([True, False])
        before, after = act(policy, batch), act(policy, {**batch, key: 1 - batch[key]})
        assert not torch.allclose(before[0], after[0], atol=1e-4)
        torch.testing.assert_close(before[1], after[1], atol=1e-6, rtol=1e-6)

    def test_tokens_change_no_output_of_images_and_language_but_the_actions(
        self, family: str, tmp_path: Path
    ) -> None:
        theirs, ours = made(family, tmp_path), made(f"mikasa_{family}", tmp_path, **TOKENS)
        missing = ours.load_state_dict(theirs.state_dict(), strict=False).missing_keys
        assert {name.split(".")[0] for name in missing} == {"memory_tokens"}
        batch, memory = batch_of(2), ours.begin_memory(2)
        actions = act(ours, batch, memory=memory)
        other = act(ours, batch, memory=memory._replace(read=-memory.read))
        assert not torch.allclose(actions, other, atol=1e-4)
        seen = [prefix_of(policy, batch, given) for policy, given in ((theirs, None), (ours, memory.read))]
        torch.testing.assert_close(seen[0], seen[1][:, :-N_TOKENS], atol=1e-5, rtol=1e-5)

    def test_memory_is_written_at_every_stride_th_frame_and_read_from_before_the_frame(
        self, family: str, tmp_path: Path
    ) -> None:
        policy = made(f"mikasa_{family}", tmp_path, **TOKENS)
        memories = [policy.begin_memory(2)]
        for step in range(4):
            memories.append(policy.remember(batch_of(2, seed=step), memories[-1]))
        changed = [not torch.equal(a.written, b.written) for a, b in itertools.pairwise(memories)]
        assert changed == [True, False, True, False]  # frames 0 and 2
        assert torch.equal(memories[1].read, memories[0].written)
        assert torch.equal(memories[3].read, memories[2].written)

    def test_training_in_segments_reads_what_a_rollout_reads(self, family: str, tmp_path: Path) -> None:
        policy = made(f"mikasa_{family}", tmp_path, **TOKENS)
        frames = [batch_of(2, seed=step) for step in range(4)]
        memory = policy.begin_memory(2)
        for frame in frames:
            memory = policy.remember(frame, memory)
        read: list[torch.Tensor] = []
        embed = policy.model.embed_prefix

        def watched(*args: Any, **kwargs: Any) -> Any:
            read.append(policy.model.given.detach())
            return embed(*args, **kwargs)

        policy.model.embed_prefix = watched
        loss_of(policy, in_segments([frames[0], frames[0], frames[2], frames[3]], n_missing=1))
        # A sample that ends with frame 3: written at 0 and 2. The first column is padding, in all samples.
        assert len(read) == 3
        torch.testing.assert_close(read[-1], memory.read, atol=1e-5, rtol=1e-5)

    def test_a_loss_reaches_back_through_so_many_segments(self, family: str, tmp_path: Path) -> None:
        policy = made(f"mikasa_{family}", tmp_path, **TOKENS)
        batch = in_segments([batch_of(1, seed=step) for step in range(4)], n_missing=0)
        batch[BASE].requires_grad_()
        loss_of(policy, batch).backward()
        reached = batch[BASE].grad.abs().sum(dim=(0, 2, 3, 4)) > 0
        assert reached.tolist() == [False, False, True, True]  # token_segments: 2

    def test_rows_of_one_pass_remember_as_they_would_alone(self, family: str, tmp_path: Path) -> None:
        policy = made(f"mikasa_{family}", tmp_path, **TOKENS)
        frames = [batch_of(2, seed=step) for step in range(3)]
        together = policy.begin_memory(2)
        for frame in frames:
            together = policy.remember(frame, together)
        alone = policy.begin_memory(1)
        for frame in frames:
            alone = policy.remember({key: values[:1] for key, values in frame.items()}, alone)
        torch.testing.assert_close(together.written[:1], alone.written, atol=1e-5, rtol=1e-5)


def test_padding_before_an_episode_is_of_no_effect(tmp_path: Path) -> None:
    policy = made("mikasa_smolvla", tmp_path, **TOKENS)
    frames = [batch_of(1, seed=step) for step in range(3)]
    batch = in_segments([frames[0], *frames], n_missing=1)
    torch.manual_seed(3)
    short = policy.forward(in_segments(frames, n_missing=0))[0]
    torch.testing.assert_close(loss_of(policy, batch), short)
    # Beside a longer one, the padded segment is computed, to no effect.
    longer = in_segments([batch_of(1, seed=9 + step) for step in range(4)], n_missing=0)
    both = {key: torch.cat([batch[key], longer[key]]) for key in batch}
    changed = {**both, BASE: both[BASE].clone()}
    changed[BASE][0, 0] = 0.5
    torch.testing.assert_close(loss_of(policy, both), loss_of(policy, changed))


def test_frames_that_are_not_given_are_missed_and_lerobots_loop_is_refused(tmp_path: Path) -> None:
    policy = made("mikasa_smolvla", tmp_path, **FRAMES)
    with pytest.raises(SpecMismatchError, match=r"images.base_m1, .*base_m1_padding_mask"):
        act(policy, batch_of(1))
    with pytest.raises(SpecMismatchError, match="mikasa-vla eval"):
        policy.select_action(batch_of(1, policy=policy))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"memory_places": -1}, "memory_places is -1, expected a number ≥ 0"),
        ({"token_stride": 0}, "token_stride is 0, expected a number ≥ 1"),
        ({"memory_tokens": 10**9}, "memory_tokens is 1000000000, expected a number ≤ 4,096"),
        ({"memory_rule": "lost"}, "rule 'lost'.*Did you mean 'last'"),
        ({"memory_stride": 0}, "memory_stride is 0"),
        ({"memory_novelty": 1.5}, "memory_novelty is 1.5"),
        ({"memory_cameras": []}, "expected each camera once"),
        ({"memory_cameras": ["observation.images.bose"]}, "Did you mean 'observation.images.base'"),
        ({"memory_tokens": 2, "compile_model": True}, "compile_model: false"),
    ],
)
def test_a_wrong_field_is_named(fields: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises((RecipeError, Exception), match=message):
        made("mikasa_smolvla", tmp_path, **fields)


def in_segments(frames: list[dict[str, Any]], *, n_missing: int) -> dict[str, Any]:
    """Return a batch (B, T, …) of frames (B, …), of which the first are before the episode's beginning."""
    batch = {key: torch.stack([frame[key] for frame in frames], dim=1) for key in frames[0]}
    padding = torch.arange(len(frames)) < n_missing
    return {**batch, SEGMENT_PADDING_KEY: padding.repeat(len(frames[0][BASE]), 1)}


def prefix_of(policy: Any, batch: dict[str, Any], given: torch.Tensor | None) -> torch.Tensor:
    """Return what the language model makes of the prefix, caught in lerobot's own call."""
    inner = getattr(policy.model, "vlm_with_expert", None) or policy.model.paligemma_with_expert
    caught: list[torch.Tensor] = []
    forward = inner.forward

    def watched(*args: Any, **kwargs: Any) -> Any:
        outputs = forward(*args, **kwargs)
        if outputs[0][0] is not None:
            caught.append(outputs[0][0])
        return outputs

    inner.forward = watched
    if given is None:
        act(policy, batch)
    else:
        act(policy, batch, memory=policy.begin_memory(len(given))._replace(read=given))
    del inner.forward
    return caught[0]
