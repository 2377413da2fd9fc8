"""Two episodes of one pair as filmstrips, where their videos were captured."""

import base64
import io
from collections.abc import Sequence

from PIL import Image

from vla_eval.page.probe_section import FilmFrame, FilmPair, Filmstrip
from vla_eval.probe.choice_pairs import ChoicePairs
from vla_eval.probe.find_worlds import Found
from vla_eval.probe.worlds import World
from vla_eval.records import EpisodeRecord
from vla_eval.storage.capture_files import video_file
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.interface import CONTROL_HZ
from vla_eval.tasks.objects.item_names import item_names

MOST_PAIRS = 3
N_FRAMES = 6
WIDTH_PX = 340  # twice of what the page shows, for screens with fine pixels
JPEG_QUALITY = 75


def film_pairs(worlds: Sequence[Found[World]], pairs: Sequence[ChoicePairs]) -> tuple[FilmPair, ...]:
    """Return the first captured pair of each policy with a swapped cue, of `MOST_PAIRS` policies."""
    runs = [one.run for one in worlds]
    films: dict[tuple[str, str, int], FilmPair] = {}
    for one in pairs:
        key = (one.world.task, one.policy, one.n_action_steps)
        if key in films or len(films) == MOST_PAIRS:
            continue
        for pair in one.pairs:
            found = [_captured(runs, record) for record in pair]
            if None not in found:
                strips = [_strip(run, record) for run, record in zip(found, pair, strict=True) if run]
                films[key] = FilmPair(
                    title=f"{one.world.task}, {one.policy} · K={one.n_action_steps}, seed {pair.drawn.seed}: "
                    f"as drawn, and {one.world.label}",
                    strips=tuple(strips),
                )
                break
    return tuple(films.values())


def _captured(runs: Sequence[StoredRun], record: EpisodeRecord) -> StoredRun | None:
    """Return the run that a record is of, if its video is there."""
    own = (run for run in runs if any(record is one for one in run.records))
    return next((run for run in own if video_file(run.path, record).is_file()), None)


def _strip(run: StoredRun, record: EpisodeRecord) -> Filmstrip:
    # Here and not above: only a page with videos waits for the decoder.
    from vla_eval.viz.filmstrip import read_strip

    assert record.n_steps is not None  # a pair has results
    frames = read_strip(
        video_file(run.path, record), n_frames=N_FRAMES, n_steps=record.n_steps, control_hz=CONTROL_HZ
    )
    names = item_names(record.task, record.n_candidates or 0)
    target = "several" if record.target is None else names[record.target]
    chosen = "none" if record.first_choice is None else names[record.first_choice]
    return Filmstrip(
        caption=f"cue {target}, chosen {chosen}: {record.outcome}",
        frames=tuple(FilmFrame(frame.step, _jpeg_uri(Image.fromarray(frame.image))) for frame in frames),
    )


def _jpeg_uri(image: Image.Image) -> str:
    file = io.BytesIO()
    height = round(image.height * WIDTH_PX / image.width)
    image.resize((WIDTH_PX, height), Image.Resampling.LANCZOS).save(file, format="JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
