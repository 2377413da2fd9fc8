"""See in images what agents are given as numbers, and act by an agent that was trained on numbers.

python scripts/seen_numbers.py ChainOfColors3-v0 runs/sight

A network of two convolutions learns from the simulator, with labels that it has no more when it acts, which
cue is shown and at which pixels of the base camera the candidates are; where they lie on the table follows
from the camera. As a policy: PYTHONPATH=scripts, and a recipe with `adapter: seen_numbers:make` and `args`:
`agent`, a run of `mikasa-vla train-agent --observation vector`, and `sight`, the folder above. Figures and
what they say: docs/capacity.md.
"""

import argparse
import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.config.agents import TRAINING_SEEDS
from vla_eval.config.environment import EnvSettings, Simulator
from vla_eval.config.prompts import instruction_for
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    ImageArray,
    MemoryArrays,
    Observation,
    ObservationWindow,
    StepObserver,
    StepResult,
)
from vla_eval.data.recording.demonstrations import ONE_BY_ONE
from vla_eval.envs.factory import make_env
from vla_eval.policies.agents.observing import PLACES, VECTOR
from vla_eval.policies.agents.policy import make_agent
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.registry import make_from_adapter
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.task_state import PrivilegedState
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.interface import CAMERA_FOV_RAD, IMAGE_SIZE_PX, base_camera_axes

CAMERA = "base_camera"
CELL_PX, N_CELLS = 2, IMAGE_SIZE_PX // 2
ROUND = 2  # cells around the likeliest one, of which the mean is taken
N_SLOTS, BATCH = 8, 64
WEIGHTS, ABOUT = "sight.safetensors", "sight.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """N frames of a task's base camera, and what is in view."""

    images: ImageArray  # (N, H, W, 3) uint8
    shown: NDArray[np.int64]  # (N,) the candidate that the cue shows; -1: none
    are_due: NDArray[np.bool_]  # (N,) whether the candidates are in view
    places_m: FloatArray  # (N, candidates, 3) world frame


def pixels_of(points_m: FloatArray) -> FloatArray:
    """Return (..., 2), column and row in px, of points (..., 3) in the world frame."""
    eye, axes = base_camera_axes()
    seen = (points_m - eye) @ axes.T
    half_px = IMAGE_SIZE_PX / 2
    right_and_down = seen[..., 1:] * (1, -1)
    pixels: FloatArray = half_px + half_px / np.tan(CAMERA_FOV_RAD / 2) * right_and_down / seen[..., :1]
    return pixels


def points_of(pixels: FloatArray, height_m: float) -> FloatArray:
    """Return the points (..., 3) at a height that are seen at pixels (..., 2)."""
    eye, axes = base_camera_axes()
    half_px = IMAGE_SIZE_PX / 2
    aside = (pixels - half_px) * (1, -1) * np.tan(CAMERA_FOV_RAD / 2) / half_px
    rays = axes[0] + aside @ axes[1:]
    points: FloatArray = eye + (height_m - eye[2]) / rays[..., 2:] * rays
    return points


class Sight(nn.Module):
    """Which cue is shown, whether candidates are in view, and at which cell of 2 x 2 pixels each is."""

    def __init__(self, n_candidates: int) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 32, 3, stride=CELL_PX, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 64, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(64, 64, 1),
            nn.ReLU(),
        )
        self.cells = nn.Conv2d(64, n_candidates, 1)
        self.cue = nn.Linear(64, n_candidates + 1)  # the first one: no cue
        self.due = nn.Linear(64, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (N, n + 1), (N,), (N, n, cells) of images (N, H, W, 3) uint8."""
        maps = self.features(images.permute(0, 3, 1, 2).float() / 127.5 - 1)
        strongest = maps.amax(dim=(2, 3))
        return self.cue(strongest), self.due(strongest)[:, 0], self.cells(maps).flatten(2)


def shares_of_cells(pixels: Tensor) -> Tensor:
    """Return (N, n, cells): how much of each pixel (N, n, 2) the four cells around it have."""
    at = (pixels / CELL_PX - 0.5).clamp(0, N_CELLS - 1.001)
    low = at.floor().long()
    after = at - low
    shares = torch.zeros(*pixels.shape[:2], N_CELLS**2)
    for right, down in itertools.product((0, 1), repeat=2):
        share = (after[..., 0] - (1 - right)).abs() * (after[..., 1] - (1 - down)).abs()
        cell = (low[..., 1] + down) * N_CELLS + low[..., 0] + right
        shares.scatter_add_(2, cell[..., None], share[..., None])
    return shares


def found_pixels(cells: Tensor) -> tuple[FloatArray, FloatArray]:
    """Return where each candidate is, (N, n, 2) in px, and how likely its likeliest cell is, (N, n)."""
    shares = cells.softmax(dim=-1)
    likely, best = shares.max(dim=-1)
    line = torch.arange(N_CELLS)
    rows, columns = best // N_CELLS, best % N_CELLS
    maps = shares.unflatten(-1, (N_CELLS, N_CELLS))
    near_row = ((line - rows[..., None]).abs() <= ROUND).float()
    near_column = ((line - columns[..., None]).abs() <= ROUND).float()
    around = maps * near_row[..., :, None] * near_column[..., None, :]
    whole = around.sum(dim=(-2, -1))
    middle = torch.stack([(around.sum(dim=-2) * line).sum(-1), (around.sum(dim=-1) * line).sum(-1)], dim=-1)
    pixels = (middle / whole[..., None] + 0.5) * CELL_PX
    return pixels.numpy().astype(np.float64), likely.numpy().astype(np.float64)


@dataclass(slots=True)
class _Seen(StepObserver):
    """The frames of a batch of episodes."""

    results: list[StepResult] = field(default_factory=list)

    def wants_images(self, step: int) -> bool:
        """Each frame is learned from."""
        return step >= 0

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Keep the frame."""
        self.results.append(result)

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep the frame; the one after an episode's last action has no image."""
        if CAMERA in result.observation.images:
            self.results.append(result)


def frames_of(task: str, *, run_seed: int, n: int, simulator: Simulator = "maniskill") -> Frames:
    """Let the scripted expert act in about `n` episodes, on seeds of trainings, and return what is seen."""
    settings = EnvSettings(
        task=task, simulator=simulator, cameras=(CAMERA,), privileged=True, n_slots=N_SLOTS
    )
    env, spec = make_env(settings), task_spec(task)
    context = PolicyContext(
        name="oracle", env=env.spec, chunking=ONE_BY_ONE, n_candidates=spec.n_candidates({}), n_slots=N_SLOTS
    )
    expert = make_from_adapter("oracle", context, {})
    first = TRAINING_SEEDS.start + run_seed * n
    rows = []
    for begin in range(first, first + n, N_SLOTS):
        starts = [
            EpisodeStart(
                slot=slot,
                task=task,
                seed=begin + slot,
                run=0,
                instruction=instruction_for(spec),
                horizon_steps=env.spec.horizon_steps,
            )
            for slot in range(N_SLOTS)
        ]
        seen = _Seen()
        rollout(
            env, expert, starts, RolloutSettings(chunking=ONE_BY_ONE, stop_at_success=True), observers=[seen]
        )
        rows += [_row(result.observation) for result in seen.results]
        print(f"{begin + N_SLOTS - first} of {n} episodes, {len(rows)} frames", flush=True)
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    return Frames(images=columns[0], shown=columns[1], are_due=columns[2], places_m=columns[3])


def _row(seen: Observation) -> tuple[ImageArray, int, bool, FloatArray]:
    world = seen.privileged
    assert isinstance(world, PrivilegedState)
    shown = world.shown_candidates[0] if world.shown_candidates else -1
    is_due = world.phase == "response"
    return seen.images[CAMERA], shown, is_due, world.candidate_positions_m.copy()


def train(frames: Frames, *, steps: int, run_seed: int) -> Iterator[tuple[int, Sight, float]]:
    """Yield after each step its number, the network and the loss."""
    torch.manual_seed(run_seed)
    network = Sight(frames.places_m.shape[1])
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps, pct_start=0.05)
    draws = np.random.default_rng(run_seed)
    groups = [np.flatnonzero(frames.are_due == is_due) for is_due in (True, False)]
    for step in range(1, steps + 1):
        chosen = np.concatenate([draws.choice(group, BATCH // 2) for group in groups])
        cue, due, cells = network(torch.from_numpy(frames.images[chosen]))
        pixels = torch.from_numpy(pixels_of(frames.places_m[chosen[: BATCH // 2]])).float()
        likelihood = (shares_of_cells(pixels) * cells[: BATCH // 2].log_softmax(dim=-1)).sum(dim=-1)
        loss = functional.cross_entropy(cue, torch.from_numpy(frames.shown[chosen]).long() + 1)
        loss = loss + functional.binary_cross_entropy_with_logits(
            due, torch.from_numpy(frames.are_due[chosen]).float()
        )
        loss = loss - likelihood.mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        yield step, network.eval(), float(loss.detach())
        network.train()


def surest(found: FloatArray, points_m: FloatArray, likely: FloatArray) -> FloatArray:
    """Return (n, 3), where on the table and how sure: as found before, or as now if that is surer."""
    surer = likely > found[:, 2]
    return np.where(surer[:, None], np.column_stack([points_m, likely]), found)


def save(folder: Path, network: Sight, *, task: str, height_m: float) -> None:
    """Write what `make` reads."""
    folder.mkdir(parents=True, exist_ok=True)
    about = {"task": task, "candidates": network.cells.out_channels, "height_m": height_m}
    save_file(network.state_dict(), folder / WEIGHTS)
    (folder / ABOUT).write_text(f"{json.dumps(about, indent=2)}\n")


class SeeingAgent:
    """An agent of numbers that is given what is seen in the base camera, and the arm's own state.

    Candidates lie still: of each, the place counts at which it was surest so far, so that one which the arm
    hides is where it was.
    """

    def __init__(self, context: PolicyContext, *, agent: str, sight: str) -> None:
        about = json.loads((Path(sight) / ABOUT).read_text())
        self._n, self._height_m = int(about["candidates"]), float(about["height_m"])
        self._network = Sight(self._n).eval()
        self._network.load_state_dict(load_file(Path(sight) / WEIGHTS))
        self._agent = make_agent(context, checkpoint=agent)
        self.spec = dataclasses.replace(
            self._agent.spec, cameras=(CAMERA,), privileged=False, has_memory=True
        )
        self._found: dict[int, FloatArray] = {}  # slot -> (n, 3): where on the table in m, how sure

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes: nothing has been seen."""
        self._found |= {episode.slot: np.zeros((self._n, 3)) for episode in episodes}
        self._agent.reset(episodes)

    def forget(self, slots: Sequence[int]) -> None:
        """Release what was kept for these slots."""
        for slot in slots:
            self._found.pop(slot, None)
        self._agent.forget(slots)

    def get_memory(self, slot: int) -> Mapping[str, np.ndarray]:  # type: ignore[type-arg]  # of any type
        """Return what the agent keeps, and where candidates were seen."""
        return {**self._agent.get_memory(slot), "sight/found": self._found[slot].copy()}

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        """Put another memory in place of a slot's."""
        kept = dict(memory)
        self._found[slot] = np.array(kept.pop("sight/found"))
        self._agent.set_memory(slot, kept)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the action for the last observation."""
        seen = window.last
        with torch.inference_mode():
            cue, due, cells = self._network(torch.from_numpy(seen.images[CAMERA].copy())[None])
        is_due = bool(due[0] > 0)
        shown = np.zeros(self._n + 1)
        shown[int(cue[0].argmax())] = 1
        places_m = np.zeros((self._n, 3))
        if is_due:
            pixels, likely = found_pixels(cells)
            points_m = points_of(pixels[0], self._height_m)
            found = surest(self._found[window.slot], points_m[:, :2], likely[0])
            self._found[window.slot] = found
            on_table = np.column_stack([found[:, :2], np.full(self._n, self._height_m)])
            places_m = on_table - seen.state["tcp_pose"][:3]
        own = [seen.state[name] for name in sorted(seen.state)]
        numbers = np.concatenate([*own, shown[1:], [float(is_due)]])
        given = {VECTOR: numbers.astype(np.float32), PLACES: places_m.astype(np.float32)}
        return self._agent.act_on(given, slot=window.slot)


def make(context: PolicyContext, *, agent: str, sight: str) -> SeeingAgent:
    """Make the policy of a recipe."""
    return SeeingAgent(context, agent=agent, sight=sight)


def main() -> None:
    """Gather, train, print how well episodes are seen that were not trained on, save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("out", type=Path)
    parser.add_argument("--episodes", type=int, default=240, help="of the expert, to learn from")
    parser.add_argument("--held-out", type=int, default=24, help="episodes, to be judged by")
    parser.add_argument("--steps", type=int, default=200, help="gradient steps of 64 frames")
    parser.add_argument("--run-seed", type=int, default=0)
    asked = parser.parse_args()
    held_out = frames_of(asked.task, run_seed=1000 + asked.run_seed, n=asked.held_out)
    frames = frames_of(asked.task, run_seed=asked.run_seed, n=asked.episodes)
    height_m = float(frames.places_m[frames.are_due][..., 2].mean())
    for step, network, loss in train(frames, steps=asked.steps, run_seed=asked.run_seed):
        if step % 50 == 0 or step == asked.steps:
            print(
                f"step {step}/{asked.steps}  loss {loss:.3f}  {judged(network, held_out, height_m)}",
                flush=True,
            )
            save(asked.out, network, task=asked.task, height_m=height_m)


def judged(network: Sight, frames: Frames, height_m: float) -> str:
    """Return how much of episodes is seen rightly."""
    with torch.inference_mode():
        parts = [network(part) for part in torch.from_numpy(frames.images).split(BATCH)]
    cue, due, cells = (torch.cat(column) for column in zip(*parts, strict=True))
    right_cue = cue.argmax(dim=1).numpy() == frames.shown + 1
    right_due = (due.numpy() > 0) == frames.are_due
    points_m = points_of(found_pixels(cells[torch.from_numpy(frames.are_due)])[0], height_m)
    off_cm = 100 * np.linalg.norm((points_m - frames.places_m[frames.are_due])[..., :2], axis=-1)
    return (
        f"of {len(right_cue)} frames: cue right in {right_cue.mean():.3f}, due in {right_due.mean():.3f}; "
        f"places off by {np.median(off_cm):.2f} cm (median; nine in ten by less than "
        f"{np.quantile(off_cm, 0.9):.2f})"
    )


if __name__ == "__main__":
    main()
