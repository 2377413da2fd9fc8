"""From a recipe to what is recorded of each task; finds mistakes before a simulator is started."""

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import av

from vla_eval.checkpoints.notes import checkpoint_hashes
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.environment import EnvSettings
from vla_eval.config.files import Recipe, load_recipe
from vla_eval.config.policy import PolicyRecipe
from vla_eval.config.prompts import load_prompts, sentences_of
from vla_eval.data.recording.demonstrations import ONE_BY_ONE
from vla_eval.data.recording.jobs import TaskPlan
from vla_eval.envs.factory import describe_env
from vla_eval.errors import RecipeError, did_you_mean
from vla_eval.evaluation.episode_jobs import EpisodeGroup, GroupKey
from vla_eval.features import EncoderSettings
from vla_eval.policies.registry import check_adapter
from vla_eval.rollout import RolloutSettings
from vla_eval.tasks.arguments import meshes_of, pinned
from vla_eval.tasks.catalog import robot_task
from vla_eval.tasks.objects.mesh_folder import without_path
from vla_eval.tasks.spec import TaskSpec


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingPlan:
    """What is recorded of each task, and the digests of recipes, prompts, weights and meshes."""

    recipe: DatasetRecipe  # as it may be stored: of a folder of meshes, name and digest
    tasks: tuple[TaskPlan, ...]
    recipe_files: dict[str, str]


def plan_recording(recipe: DatasetRecipe) -> RecordingPlan:
    """Find what can be wrong with a recipe before a simulator is started."""
    check_encoder(recipe.encoder)
    expert = load_recipe("policies", recipe.expert, PolicyRecipe)
    check_adapter(expert.value.adapter)
    prompts = load_prompts(recipe.prompt_set)
    specs = [robot_task(task, does="`record` makes demonstrations of") for task in recipe.tasks]
    env = pinned(recipe.env, specs)
    recipe = replace(recipe, env=without_path(env))
    meshes = meshes_of(env)
    return RecordingPlan(
        recipe=recipe,
        tasks=tuple(_task_plan(recipe, env, expert, sentences_of(prompts, spec)[0], spec) for spec in specs),
        recipe_files={
            f"policies/{expert.name}": expert.sha256,
            f"prompts/{prompts.name}": prompts.sha256,
            **checkpoint_hashes(expert.value.adapter, expert.value.args, policy=expert.name),
            **({} if meshes is None else meshes.hashes),
        },
    )


def _task_plan(
    recipe: DatasetRecipe,
    arguments: Mapping[str, Any],  # Any: plain data
    expert: Recipe[PolicyRecipe],
    instruction: str,
    spec: TaskSpec,
) -> TaskPlan:
    env = EnvSettings(task=spec.id, kwargs=arguments, simulator=recipe.simulator, render=recipe.render)
    return TaskPlan(
        group=EpisodeGroup(
            key=GroupKey(spec.id, expert.name, 1),
            adapter=expert.value.adapter,
            args=expert.value.args,
            env=env,
            offered=describe_env(env),
            n_candidates=spec.n_candidates(recipe.env),
            rollout=RolloutSettings(
                chunking=ONE_BY_ONE,
                stop_at_success=recipe.cut == "after_success",
                steps_after_success=recipe.steps_after_success,
            ),
            instruction=instruction,
        ),
        task_version=spec.version,
        expert_version=expert.value.version,
        recipe=recipe,
    )


SOFTWARE = ("h264", "hevc", "libsvtav1", "libaom-av1")
OF_A_DEVICE = (
    *("h264_videotoolbox", "hevc_videotoolbox", "h264_nvenc", "hevc_nvenc", "h264_vaapi", "h264_qsv"),
    "auto",
)
"""With those above, all that lerobot 0.6.1 takes. Workers may be on a machine that has the device."""
ALIASES = {"av1": "libsvtav1"}  # lerobot's
SIDE_PX, FPS = 128, 20  # of what tasks render
N_COLOURS = 3
N_FRAMES = 4  # x265 sometimes fails to end a video of one or two


def check_encoder(settings: EncoderSettings) -> None:
    """Encode some frames, unless the encoder is a device's; `RecipeError` if it takes no such settings."""
    name = ALIASES.get(settings.vcodec, settings.vcodec)
    known = (*SOFTWARE, *OF_A_DEVICE)
    if name not in known:
        raise RecipeError(
            f"encoder.vcodec is '{name}', expected one of {', '.join(known)}.{did_you_mean(name, known)}"
        )
    if name in OF_A_DEVICE:
        return
    try:
        known_formats = av.Codec(name, "w").video_formats or ()
        formats = [one.name for one in known_formats if len(one.components) == N_COLOURS]
    except av.codec.codec.UnknownCodecError as exc:
        raise RecipeError(
            f"encoder.vcodec: PyAV has no encoder '{name}' on this machine. Choose another one of "
            f"{', '.join(SOFTWARE)}."
        ) from exc
    if settings.pix_fmt not in formats:
        raise RecipeError(
            f"encoder.pix_fmt: '{name}' takes {', '.join(formats)}; found '{settings.pix_fmt}'. Choose one "
            "of these, or another encoder.vcodec. yuv444p keeps the colour of every pixel."
        )
    try:
        _encode_some_frames(name, settings)
    except av.FFmpegError as exc:
        raise RecipeError(
            f"encoder: '{name}' does not take pix_fmt {settings.pix_fmt} with crf {settings.crf} and g "
            f"{settings.g} ({exc}). Change the section `encoder`, or leave it out."
        ) from exc


def _encode_some_frames(name: str, settings: EncoderSettings) -> None:
    options = {"g": str(settings.g), "crf": str(settings.crf)}
    with av.open(io.BytesIO(), "w", format="mp4") as container:
        stream: Any = container.add_stream(name, FPS, options=options)  # Any: a VideoStream
        stream.pix_fmt, stream.width, stream.height = settings.pix_fmt, SIDE_PX, SIDE_PX
        for _ in range(N_FRAMES):
            container.mux(stream.encode(av.VideoFrame(SIDE_PX, SIDE_PX, "rgb24")))
        container.mux(stream.encode())
