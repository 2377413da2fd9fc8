"""The paper's three stages on a real arm, simulated: one cube is to be picked; how it is shown differs."""

from typing import Any, Literal

import sapien

from vla_eval.seeding import Stream, generator
from vla_eval.tasks.memory_env import CueSize, Place, poses
from vla_eval.tasks.objects.bodies import Flags, Indices, Steps, anywhere
from vla_eval.tasks.objects.items import CUBE_HALF_SIZE_M
from vla_eval.tasks.objects.limits import Positive
from vla_eval.tasks.real_stages import COLORS
from vla_eval.tasks.remember import RememberColorEnv
from vla_eval.tasks.tensors_out import Info

COVER_HALF_M = (0.06, 0.16, 0.03)  # over the three places of the cubes, and higher than a cube
COVER_RGBA = (0.2, 0.2, 0.2, 1.0)


class RealTwinEnv(RememberColorEnv):
    """RealTwin: pick the red, green or blue cube, as on the paper's real SO-101.

    Description: `visible`: the three cubes lie there, and the instruction names the colour. `thrown_in`: the
    right cube alone lies at its place (cue), then the two others lie beside it (response). `shuffled`: the
    right cube lies at the middle (cue), a cover hides the table (delay), then the three cubes lie in random
    order (response).

    Source: the paper, appendix "Real-World Experiments". What it does not give is ours: durations, places
    (those of RememberColor3), the height to which a cube has to be lifted.

    Observation space: `state` as that of RememberColor.

    Rewards: those of RememberColor, which end at the cube: they are not made for training here.

    Starting state: arm at rest with joint noise of 0.02 rad; colour uniform; places permuted uniformly.

    Episode end: after the control steps of its row; success is reported and ends nothing by itself.

    Arguments: `stage`; `cube_lift_m`, by which the right cube has to be lifted; and those of RememberColor.

    Chance level: 1 / 3 for a perfect arm that knows neither instruction nor cue.

    Version history: 1, first version.
    """

    FAMILY = 13

    def __init__(
        self,
        *args: Any,
        stage: Literal["visible", "thrown_in", "shuffled"] = "visible",
        cube_lift_m: Positive = 0.05,
        **kwargs: Any,
    ) -> None:
        self.stage = stage
        self.cube_lift_m = cube_lift_m
        super().__init__(*args, **kwargs)

    def _load_items(self) -> None:
        super()._load_items()
        builder = self.scene.create_actor_builder()
        if self.scene.can_render():
            material = sapien.render.RenderMaterial(base_color=COVER_RGBA)
            builder.add_box_visual(half_size=COVER_HALF_M, material=material)
        builder.initial_pose = self._cover_parked()
        self.cover = builder.build_kinematic(name="cover")

    def _cover_parked(self) -> sapien.Pose:
        return self.parking_pose("cover", half_height_m=COVER_HALF_M[2])

    def wording(self, env: int) -> dict[str, str]:
        """Return the word for the colour in the instruction of one environment's episode."""
        color = self.items[int(self._target[env])].color
        assert color is not None  # of every cube
        return {"color": color.name}

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        moved = super()._on_phase_edges(step, mask)
        if self.stage != "shuffled" or not anywhere(step <= self._response_step):
            return moved
        covers = mask & (step == self._cue_end_step) & (self._cue_end_step < self._response_step)
        reveals = mask & (step == self._response_step)
        self.move(self.cover, covers, sapien.Pose([0.0, 0.0, COVER_HALF_M[2]]))
        self.move(self.cover, reveals, self._cover_parked())
        return moved or anywhere(covers | reveals)

    def _on_episode_start(self, mask: Flags) -> None:
        super()._on_episode_start(mask)
        self.move(self.cover, mask, self._cover_parked())

    def _show_in_middle(self, mask: Flags, drawn: Indices, shown: Indices) -> None:
        if self.stage != "thrown_in":
            super()._show_in_middle(mask, drawn, shown)
            return
        at_drawn, at_shown = (poses(self._slots[self._rows, which]) for which in (drawn, shown))
        for index, cube in enumerate(self.candidates):
            if self._hides_items:
                self.move(cube, mask & (drawn == index), at_drawn)
                self.move(self.decoys[index], mask & (shown == index), at_shown)
            else:
                self.move(cube, mask & (shown == index), at_shown)

    def cue_places_m(self, env: int) -> list[Place]:
        """Return where the cube is shown, on the table, world frame."""
        if self.stage != "thrown_in":
            return super().cue_places_m(env)
        x, y, _ = (float(number) for number in self._slots[env, self._target[env]])
        return [(x, y, 0.0)]

    def evaluate(self) -> Info:
        """Read success: the right cube is lifted in the response phase; changes nothing."""
        info = super().evaluate()
        height_m = self._of_target(self.candidate_positions_m()[..., 2]) - CUBE_HALF_SIZE_M
        lifted = height_m >= self.cube_lift_m
        return {**info, "success": self.gated(lifted) & ~info["fail"]}

    def cue_size_m(self) -> CueSize:
        """Return the size of a cube."""
        return CueSize(half_width_m=CUBE_HALF_SIZE_M, height_m=2 * CUBE_HALF_SIZE_M)


def drawn(seed: int) -> tuple[int, tuple[int, ...]]:
    """Return the right cube of an episode, and the place of each from the arm's right, without a simulator.

    As `RememberEnv` draws them. The places are 10 cm apart in y: their jitter of 1 cm changes no order.
    """
    key = (RealTwinEnv.FAMILY, len(COLORS))
    target = int(generator(seed, Stream.TARGET, *key).integers(len(COLORS)))
    order = generator(seed, Stream.PERMUTATION, *key).permutation(len(COLORS))  # places, from the left
    return target, tuple(len(COLORS) - 1 - int(index) for index in order)
