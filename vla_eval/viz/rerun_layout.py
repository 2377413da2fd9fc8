"""The layout of an episode in the rerun viewer."""

from collections.abc import Sequence

import rerun.blueprint as rrb


def layout(
    cameras: Sequence[str], action_dims: Sequence[str], state_dims: Sequence[str] = ()
) -> rrb.Blueprint:
    """Return the blueprint: the world and the cameras with images above, curves and words below.

    `state_dims` are the entries of the proprioception; of datasets alone.
    """
    views = [rrb.Spatial2DView(origin=f"cameras/{name}", name=name) for name in cameras]
    above = rrb.Horizontal(
        rrb.Spatial3DView(origin="world", name="world"),
        *([rrb.Grid(*views)] if views else []),
        rrb.Vertical(
            rrb.TextDocumentView(origin="instruction", name="instruction"),
            rrb.TextLogView(origin="events", name="events"),
            row_shares=[1, 2],
        ),
        column_shares=[3, *([3] if views else []), 2],
    )
    curves = rrb.Tabs(
        *(rrb.TimeSeriesView(origin=f"actions/{name}", name=name) for name in action_dims),
        *([rrb.TimeSeriesView(origin="state", name="state")] if state_dims else []),
        name="actions",
    )
    states = rrb.Vertical(
        rrb.TimeSeriesView(origin="phase", name="phase"),
        rrb.TimeSeriesView(
            origin="/", contents=["/gripper/**", "/reward", "/success", "/choice/**"], name="gripper, reward"
        ),
    )
    below = rrb.Horizontal(curves, states, column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[3, 2]),
        rrb.TimePanel(timeline="step", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
