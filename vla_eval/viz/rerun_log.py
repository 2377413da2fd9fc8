"""Write a taped episode as an `.rrd` for the rerun viewer; docs/captures.md lists entities and timelines."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import rerun as rr

from vla_eval.control_modes import N_ARM_JOINTS
from vla_eval.core import FloatArray
from vla_eval.oracles.kinematics import FLANGE_M, TCP_M, joint_poses
from vla_eval.records import EpisodeRecord
from vla_eval.specs import EnvSpec
from vla_eval.storage.capture_files import capture_stem
from vla_eval.task_state import PHASES, PrivilegedState
from vla_eval.tasks.objects.item_names import item_names
from vla_eval.viz.rerun_file import layout, rrd_when_whole, send_curve, set_step
from vla_eval.viz.tape import EpisodeTape, TapedStep

TCP_POSE, JOINTS, N_FINGERS = "tcp_pose", "qpos", 2
JPEG_QUALITY = 90
ROBOT_BASE_M = (-0.615, 0.0, 0.0)  # where the tasks put the Panda
SAME_PLACE_M = 0.01
COLORS = {
    "right": (0, 158, 115),
    "other": (163, 169, 181),
    "tcp": (0, 114, 178),
    "body": (230, 159, 0),
    "arm": (86, 97, 112),
}


def write_rrd(tape: EpisodeTape, record: EpisodeRecord, path: Path, *, env: EnvSpec) -> None:
    """Write one episode; the file is there whole or not at all, with a `ViewingError` in its place."""
    n_series = n_overlapping(tape)
    cameras = sorted({name for one in tape.steps for name in one.result.observation.images})
    with rrd_when_whole(
        path,
        recording_id=capture_stem(record),
        blueprint=layout(cameras, env.action.dims),
        failed=f"the rerun file of {record.policy} on {record.task}, seed {record.seed}, could not be "
        "written",
        advice="Free some space, or capture less; the same command runs it again.",
    ) as stream:
        _log_facts(stream, tape, record)
        for taped in tape.steps:
            set_step(stream, taped.step, env.control_hz)
            _log_step(stream, taped, env.action.dims)
        # Each chunk at the steps that it was meant for: the executed part, and what was never executed.
        for index in range(n_series):
            own = tape.chunks[index::n_series]
            if not own:
                continue
            steps = np.concatenate([np.arange(len(one.chunk.actions)) + one.step for one in own])
            values = np.concatenate([one.chunk.actions for one in own])
            for dim, name in enumerate(env.action.dims):
                send_curve(stream, f"actions/{name}/predicted_{index}", steps, values[:, dim], env.control_hz)
        for step, text in sorted(events(tape, record)):
            set_step(stream, step, env.control_hz)
            stream.log("events", rr.TextLog(text))
            if text.startswith("first choice"):
                stream.log("choice/first", rr.Scalars(1.0))


def _log_facts(stream: rr.RecordingStream, tape: EpisodeTape, record: EpisodeRecord) -> None:
    status = tape.steps[-1].result.status
    names = item_names(record.task, status.n_candidates, given=status.candidate_names)
    target = "several, or none" if status.target is None else names[status.target]
    chosen = "none" if status.first_choice is None else names[status.first_choice]
    lines = [
        f"# {tape.start.instruction}",
        f"{record.task}, {record.policy}, K={record.n_action_steps}, run {record.run}, seed {record.seed}",
        f"**{record.outcome}**"
        + (f" at step {record.success_step}" if record.success_step is not None else ""),
    ]
    lines += [f"target: {target}; chosen first: {chosen}"] if status.n_candidates else []
    text = rr.TextDocument("\n\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    stream.log("instruction", text, static=True)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("world/robot_base", rr.Points3D([ROBOT_BASE_M], radii=0.05, labels=["robot"]), static=True)
    way = [pose[:3] for one in tape.steps if (pose := one.result.observation.state.get(TCP_POSE)) is not None]
    if way:
        strip = rr.LineStrips3D([np.stack(way)], colors=[COLORS["tcp"]], radii=0.002)
        stream.log("world/tcp_path", strip, static=True)


def _log_step(stream: rr.RecordingStream, taped: TapedStep, action_dims: Sequence[str]) -> None:
    result = taped.result
    for name, image in result.observation.images.items():
        stream.log(f"cameras/{name}", rr.Image(image).compress(jpeg_quality=JPEG_QUALITY))
    state = result.observation.state
    if TCP_POSE in state:
        point = rr.Points3D([state[TCP_POSE][:3]], colors=[COLORS["tcp"]], radii=0.012)
        stream.log("world/tcp", point)
    if JOINTS in state:
        stream.log("gripper/width", rr.Scalars(float(state[JOINTS][-N_FINGERS:].sum())))
    if JOINTS in state and TCP_POSE in state:
        log_arm(stream, state[JOINTS], state[TCP_POSE][:3])
    _log_world(stream, taped)
    for phase in PHASES:
        stream.log(f"phase/{phase}", rr.Scalars(float(result.status.phase == phase)))
    if taped.action is not None:
        stream.log("reward", rr.Scalars(result.reward))
        _log_action(stream, "asked", taped.action, action_dims)
        if result.executed_action is not None:
            _log_action(stream, "executed", result.executed_action, action_dims)


def log_arm(stream: rr.RecordingStream, qpos: FloatArray, tcp_position_m: FloatArray) -> None:
    """Log the arm as a line through its joints; nothing if it is not the Panda's."""
    points = arm_points_m(qpos, tcp_position_m)
    if points is not None:
        stream.log("world/arm", rr.LineStrips3D([points], colors=[COLORS["arm"]], radii=0.02))


def arm_points_m(qpos: FloatArray, tcp_position_m: FloatArray) -> FloatArray | None:
    """Return (10, 3): base, joints, flange and tool, m, world frame; None for another arm than the Panda."""
    if len(qpos) < N_ARM_JOINTS:
        return None
    poses = joint_poses(qpos)
    joints = poses[:, :3, 3]
    tips = [joints[-1] + poses[-1, :3, 2] * along_m for along_m in (FLANGE_M, FLANGE_M + TCP_M)]
    points = (np.stack([np.zeros(3), *joints, *tips]) + ROBOT_BASE_M).astype(np.float32)
    return None if np.linalg.norm(points[-1] - tcp_position_m) > SAME_PLACE_M else points


def _log_world(stream: rr.RecordingStream, taped: TapedStep) -> None:
    world = taped.result.observation.privileged
    if not isinstance(world, PrivilegedState):
        return
    if len(world.candidate_positions_m):
        indices = range(len(world.candidate_positions_m))
        right = [index in world.right_candidates for index in indices]
        points = rr.Points3D(
            world.candidate_positions_m,
            colors=[COLORS["right" if is_right else "other"] for is_right in right],
            labels=[f"{index}: right" if right[index] else str(index) for index in indices],
            radii=0.02,
        )
        stream.log("world/candidates", points)
    for name, body in world.bodies.items():
        point = rr.Points3D([body.position_m], colors=[COLORS["body"]], labels=[name], radii=0.02)
        stream.log(f"world/bodies/{name}", point)


def _log_action(stream: rr.RecordingStream, kind: str, action: FloatArray, dims: Sequence[str]) -> None:
    for name, value in zip(dims, action, strict=True):
        stream.log(f"actions/{name}/{kind}", rr.Scalars(float(value)))


def n_overlapping(tape: EpisodeTape) -> int:
    """Return how many series are needed so that no two chunks of one series overlap."""
    starts = [one.step for one in tape.chunks]
    gaps = [later - earlier for earlier, later in pairwise(starts)]
    longest = max((len(one.chunk.actions) for one in tape.chunks), default=1)
    return -(-longest // max(min(gaps, default=longest), 1))


def events(tape: EpisodeTape, record: EpisodeRecord) -> Iterable[tuple[int, str]]:
    """Yield (step, what happened): phases that begin, inferences, the first choice, success."""
    yield from ((one.step, f"inference, {len(one.chunk.actions)} actions") for one in tape.chunks)
    before: Sequence[TapedStep | None] = [None, *tape.steps[:-1]]
    for earlier, one in zip(before, tape.steps, strict=True):
        status, last = one.result.status, earlier.result.status if earlier else None
        if status.phase is not None and (last is None or last.phase != status.phase):
            yield one.step, f"phase {status.phase}"
        if status.first_choice is not None and (last is None or last.first_choice is None):
            is_right = status.first_choice in status.right_first_choices
            yield one.step, f"first choice: {status.first_choice}, {'right' if is_right else 'wrong'}"
    if record.success_step is not None:
        yield record.success_step, "success"
