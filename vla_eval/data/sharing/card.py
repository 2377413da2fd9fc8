"""Write a dataset's card, the same for the same dataset: the Hub's `README.md` and a contact sheet."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import yaml
from huggingface_hub import DatasetCard, DatasetCardData
from numpy.typing import NDArray

from vla_eval.control_modes import JOINT_DELTA_POS, MOTORS
from vla_eval.data.exact_statistics import RESOLUTION, about_still_dimensions
from vla_eval.data.facts import DatasetFacts, ImportFacts, MixtureFacts
from vla_eval.data.manifest import MANIFEST_FILE
from vla_eval.data.opening import OpenDataset, open_dataset
from vla_eval.data.sharing.sheet import draw_sheet
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, SUCCESS_KEY
from vla_eval.results.cells import markdown_block, markdown_cell, markdown_code
from vla_eval.storage.durable import replace_file
from vla_eval.tasks.catalog import find_task

CARD_FILE = Path("README.md")
SHEET_FILE = Path("images/contact_sheet.png")
OWN_LICENSE = "mit"  # of what is recorded here; of an import nothing is known
MAX_SEEDS_SHOWN = 40


def write_card(root: Path, *, license_id: str | None = None) -> str:
    """Write card and contact sheet, and return the card's text; the licence is named as on the Hub."""
    dataset = open_dataset(root)
    if dataset.facts.control_mode == MOTORS:
        raise DatasetError(
            f"{root}: expected demonstrations of a simulated task, found those of an arm: there is no card"
            " for these yet. Write README.md by hand, and upload by `hf upload --repo-type dataset`."
        )
    (root / SHEET_FILE).parent.mkdir(exist_ok=True)
    (root / SHEET_FILE).write_bytes(draw_sheet(dataset))
    text = _render(dataset, license_id=license_id)
    replace_file(root / CARD_FILE, text)
    return text


def _render(dataset: OpenDataset, *, license_id: str | None = None) -> str:
    facts = dataset.facts
    if license_id is None and (
        all(source.task_version is not None for source in facts.sources)
        if isinstance(facts, MixtureFacts)
        else isinstance(facts, DatasetFacts)
    ):
        license_id = OWN_LICENSE
    sections = [f"# {_title(dataset)}\n", _introduction(dataset)]
    for heading, section in _SECTIONS.items():
        text = section(dataset)
        if text:
            sections.append(f"## {heading}\n\n{text}")
    if license_id is None:
        sections.append("## Licence\n\nThat of the source, which the converter does not know.\n")
    data = DatasetCardData(
        license=license_id,
        task_categories=["robotics"],
        tags=["LeRobot", "ManiSkill", "memory", "mikasa-vla"],
        # Without it the Hub's viewer guesses, and shows the manifest as data.
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    text = "\n".join(sections)
    return str(DatasetCard(f"---\n{data.to_yaml()}\n---\n\n{text}"))


def _title(dataset: OpenDataset) -> str:
    facts, n_episodes = dataset.facts, len(dataset.lengths)
    if isinstance(facts, MixtureFacts):
        return f"{len(facts.tasks)} tasks of {len(facts.sources)} datasets: {n_episodes} demonstrations"
    n_success = n_episodes - len(dataset.failed)
    what = f"episodes, {n_success} with success" if dataset.failed else "demonstrations"
    return f"{markdown_cell(facts.task or 'Imported demonstrations')}: {n_episodes} {what}"


def _introduction(dataset: OpenDataset) -> str:
    facts = dataset.facts
    task = find_task(facts.task) if isinstance(facts, DatasetFacts) else None
    about = f"{task.description} " if task else ""
    instructions = sorted(str(sentence) for sentence in dataset.meta.tasks.index)
    sentences = "\n".join(f"> {markdown_cell(sentence)}" for sentence in instructions)
    height_px, width_px = dataset.meta.features[next(iter(CAMERA_KEYS.values()))]["shape"][:2]
    size = f"{height_px} × {width_px}"
    heading = "Instruction" if len(instructions) == 1 else "Instructions"
    return (
        f"{about}Two cameras of {size} pixels, 20 frames per second, one frame per control step, as a "
        f"LeRobotDataset v3.\n\n{heading}:\n\n{sentences}\n\n![A few episodes]({SHEET_FILE.as_posix()})\n"
    )


def _statistics(dataset: OpenDataset) -> str:
    lengths, features = np.array(dataset.lengths), dataset.meta.features
    is_stored = SUCCESS_KEY in features
    n_success = str(len(lengths) - len(dataset.failed)) if is_stored else "not stored"
    rows = [
        ("episodes", str(len(lengths))),
        ("frames", str(lengths.sum())),
        ("frames per episode", f"{lengths.min()} to {lengths.max()}, mean {lengths.mean():.1f}"),
        ("episodes with success", n_success),
    ]
    still = [*about_still_dimensions(dataset.meta.stats, features)]
    if dataset.manifest:
        seeds = [episode.seed for episode in dataset.manifest]
        experts = sorted({f"{one.expert}, version {one.expert_version}" for one in dataset.manifest})
        rows += [
            ("seeds", f"{min(seeds)} to {max(seeds)}"),
            ("seeds left out because the expert failed", _listed([one.seed for one in dataset.failed_seeds])),
            (
                "seeds kept although the expert failed",
                _listed([one.seed for one in dataset.manifest if one.success_step is None]),
            ),
            ("expert", markdown_cell("; ".join(experts))),
        ]
    action = _actions(dataset)
    columns = (action.mean(axis=0), action.std(axis=0), action.min(axis=0), action.max(axis=0))
    numbers = zip(_action_names(dataset), *columns, strict=True)
    lines = [f"| {name} | {value} |" for name, value in rows]
    per_dim = [
        f"| {markdown_cell(name)} | {mean:.4f} | {std:.4f} | {low:.4f} | {high:.4f} |"
        for name, mean, std, low, high in numbers
    ]
    return "\n".join(
        [
            *("| | |", "|:--|:--|", *lines, ""),
            *("| action | mean | std | min | max |", "|:--|--:|--:|--:|--:|", *per_dim, ""),
            *((*(f"- {markdown_cell(line)}" for line in still), "") if still else ()),
        ]
    )


def _actions(dataset: OpenDataset) -> NDArray[np.float64]:
    return dataset.columns[ACTION_KEY].astype(np.float64)


def _action_names(dataset: OpenDataset) -> tuple[str, ...]:
    feature = dataset.meta.features[ACTION_KEY]
    return tuple(map(str, feature.get("names") or range(feature["shape"][0])))


def idle_actions(names: Sequence[str], stds: NDArray[np.float64]) -> list[str]:
    """Return the dimensions that hardly vary, which a normalisation by the standard deviation blows up."""
    return [name for name, std in zip(names, stds, strict=True) if std < RESOLUTION]


def _listed(seeds: Sequence[int]) -> str:
    shown = ", ".join(map(str, seeds[:MAX_SEEDS_SHOWN]))
    more = f" and {len(seeds) - MAX_SEEDS_SHOWN} more" if len(seeds) > MAX_SEEDS_SHOWN else ""
    return f"{len(seeds)}: {shown}{more}" if seeds else "none"


def _fields(dataset: OpenDataset) -> str:
    lines = []
    for name, feature in sorted(dataset.meta.features.items()):
        shape = " × ".join(str(size) for size in feature["shape"])
        lines.append(f"| {markdown_code(name)} | {markdown_cell(f'{feature["dtype"]} ({shape})')} |")
    return "\n".join(["| field | type |", "|:--|:--|", *lines, ""])


def _origin(dataset: OpenDataset) -> str:
    facts, replay = dataset.facts, dataset.replay
    if not isinstance(facts, DatasetFacts):
        return ""
    said = "not replayed yet (`mikasa-vla replay`)"
    if replay is not None:
        verdict = "passed" if replay.passed else f"FAILED ({len(replay.mismatches)} mismatches)"
        compared = markdown_cell(replay.states_compared)
        said = f"{verdict}: {replay.n_episodes} of {replay.n_total} episodes, states {compared}"
    rows = [
        ("task rules", f"{markdown_cell(facts.task)}, version {facts.task_version}"),
        ("replay", said),
        (
            "renderer",
            markdown_cell(", ".join(f"{key} {value}" for key, value in sorted(facts.device.items()))),
        ),
        ("recipe sha256", markdown_code(facts.recipe_sha256)),
        ("manifest sha256", markdown_code(facts.files[MANIFEST_FILE.as_posix()].sha256)),
        *(
            (f"{markdown_cell(name)} sha256", markdown_code(digest))
            for name, digest in sorted(facts.recipe_files.items())
        ),
    ]
    lines = "\n".join(f"| {name} | {value} |" for name, value in rows)
    recipe = yaml.safe_dump(facts.recipe, sort_keys=True, allow_unicode=True)
    return (
        f"`meta/mikasa/manifest.jsonl` has seed and actions of every episode: `mikasa-vla replay` checks the "
        f"dataset with it. Digests of all files are in `meta/mikasa/recording.json`.\n\n"
        f"| | |\n|:--|:--|\n{lines}\n\nRecipe:\n\n{markdown_block(recipe, 'yaml')}\n"
    )


def _import(dataset: OpenDataset) -> str:
    facts = dataset.facts
    if not isinstance(facts, ImportFacts):
        return ""
    lines = [
        f"- layout of the source: {markdown_code(facts.source_layout)}; digests of its files: "
        f"`meta/mikasa/import.json`",
        f"- instruction: {markdown_cell(facts.instruction_source)}",
        f"- fields that the source does not have: {markdown_cell(', '.join(facts.absent)) or 'none'}",
        f"- arrays of the source that were left out: {markdown_cell(', '.join(facts.left_out)) or 'none'}",
        f"- actions are for the control mode {markdown_code(facts.control_mode)}",
    ]
    if not facts.executable_by_pd_ee_delta_pose:
        lines.append(
            "- **not executable by `pd_ee_delta_pose`**: a policy trained on these actions is evaluated with "
            f"{markdown_code(f'env.control_mode={facts.control_mode}')}"
        )
    return "\n".join([*lines, ""])


def _mixture(dataset: OpenDataset) -> str:
    facts = dataset.facts
    if not isinstance(facts, MixtureFacts):
        return ""
    rows = [
        (
            markdown_cell(one.name),
            "—" if one.task is None else markdown_cell(one.task),
            "—" if one.task_version is None else str(one.task_version),
            str(one.n_episodes),
            str(one.n_frames),
            f"{min(one.seeds)} to {max(one.seeds)}" if one.seeds else "—",
            "yes" if one.was_replayed else "no",
            markdown_code(one.sha256),
        )
        for one in facts.sources
    ]
    lines = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return (
        "Mixed by `mikasa-vla dataset mix`; episodes are in this order. `meta/mikasa/mixture.json` has the "
        "seeds and the digests of all files. A mixture has no manifest: replay its sources.\n\n"
        "| dataset | task | rules | episodes | frames | seeds | replayed | sha256 |\n"
        f"|:--|:--|--:|--:|--:|:--|:--|:--|\n{lines}\n\nActions are for the control mode "
        f"{markdown_code(facts.control_mode)}.\n"
    )


def _differences(dataset: OpenDataset) -> str:
    facts = dataset.facts
    if not isinstance(facts, DatasetFacts):
        return ""
    after = markdown_cell(str(facts.recipe.get("steps_after_success")))
    cut = f"{after} steps after the first success"
    cut = "at the horizon" if facts.recipe.get("cut") == "horizon" else cut
    is_intended = facts.recipe.get("stored_action") == "intended"
    stored = (
        "as the expert asked for them, before noise was added" if is_intended else "as they were executed"
    )
    lines = [
        "- The simulation is a new implementation of the tasks, not the authors' code "
        "(`docs/tasks.md` of mikasa-vla-eval lists what differs).",
        _expert_difference(facts, dataset),
        f"- Kept: {markdown_cell(str(facts.recipe.get('keep', 'successes')))}; the paper says that all of "
        f"its episodes succeed, and its recorder kept every episode, whether it succeeded or not.",
        f"- Cut: {cut}; the paper's recorder recorded to the horizon.",
        f"- Actions are for {markdown_code(facts.control_mode)}, {stored}; the paper's recordings "
        f"for reinforcement learning are for {markdown_code(JOINT_DELTA_POS)}.",
        "- Images are video (lossy); the paper's are arrays of pixels.",
    ]
    render = facts.recipe.get("render")
    if isinstance(render, dict) and render.get("wrist_mesh") == "simplified":
        lines.append("- The wrist camera's housing is drawn with a simpler mesh.")
    return "\n".join([*lines, ""])


def _expert_difference(facts: DatasetFacts, dataset: OpenDataset) -> str:
    text = "- The paper's experts were trained by PPO; here the expert is "
    text += markdown_code(str(facts.recipe.get("expert", "oracle")))
    noise = facts.recipe.get("action_noise", 0.0)
    text += (
        f", with noise of std {markdown_cell(str(noise))} in its actions." if noise else ", without noise."
    )
    idle = idle_actions(_action_names(dataset), _actions(dataset).std(axis=0))
    if idle:
        text += (
            f" Of its actions {', '.join(idle)} hardly vary (std below {RESOLUTION:g}): "
            f"expect imitation to be easier than with the paper's data."
        )
    return text


_SECTIONS: dict[str, Callable[[OpenDataset], str]] = {
    "Statistics": _statistics,
    "Fields": _fields,
    "Origin and proof": _origin,
    "Import": _import,
    "Sources": _mixture,
    "Differences from the paper's data": _differences,
}
