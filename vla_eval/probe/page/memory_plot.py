"""What linear probes find in a memory, over the control steps."""

from collections.abc import Sequence

from vla_eval.page.charts import Curves, Point, Series
from vla_eval.probe.decoding import TIME, Decoded
from vla_eval.probe.decoding_text import decoding_sentences


def decoding_curves(found: Sequence[Decoded]) -> dict[tuple[str, str], Curves]:
    """Return (task, label) -> its curves over the control steps, of all policies."""
    drawn = {}
    colors = {name: number for number, name in enumerate(dict.fromkeys(map(_line_name, found)))}
    for task, label in dict.fromkeys((one.task, one.label) for one in found if one.label != TIME):
        own = [one for one in found if (one.task, one.label) == (task, label)]
        steps = sorted({point.step for one in own for point in one.steps})
        series = [
            Series(
                name=_line_name(one),
                color=colors[_line_name(one)],
                points=tuple(Point(p.step, p.memory.rate, *p.memory.interval) for p in one.steps),
            )
            for one in own
        ]
        level = tuple(Point(step, own[0].chance) for step in (steps[0], steps[-1]))
        drawn[task, label] = Curves(
            series=[*series, Series(name="chance", color=0, points=level, kind="chance")],
            title=f"{task}: {label} in the memory (response from step {own[0].response_step} on)",
            description="; ".join(decoding_sentences(own)),
            x_title="control step of the inference",
            x_ticks=[float(step) for step in steps],
            x_labels=[str(step) for step in steps],
        )
    return drawn


def _line_name(one: Decoded) -> str:
    return f"{one.policy} · K={one.n_action_steps}"
