"""Parts of the positive control's network: what it sees, where it goes, and that it learns to recall."""

import math

import numpy as np
import pytest
import torch

from vla_eval.models.memory.action_head import ActionHead
from vla_eval.models.memory.goal_layer import GoalLayer, Goals
from vla_eval.models.memory.network import MemoryNetwork
from vla_eval.models.memory.sizes import QUARTERS, NetworkSizes
from vla_eval.models.memory.vision_encoder import LEAST_COLOR_VARIANCE, VisionEncoder, standing_out


class TestStandingOut:
    def test_a_hue_that_is_rare_stands_out_and_light_and_shade_do_not(self) -> None:
        draws = torch.Generator().manual_seed(0)
        brightness = 0.6 + 0.3 * torch.rand(1, 1, 16, 16, generator=draws)
        picture = brightness * torch.tensor([1.0, 0.5, 0.2])[:, None, None]  # orange, bright and dark
        picture[0, :, 3, 5] = torch.tensor([0.9, 0.05, 0.05])  # red, about as bright
        apart = standing_out(2 * picture - 1)[0, 0]
        assert divmod(int(apart.argmax()), 16) == (3, 5)
        others = apart.flatten().sort().values[:-1]
        assert apart[3, 5] > others[-1] + 0.5  # e^(4 · 0.5) times as important to begin with

    def test_it_is_half_the_logarithm_of_the_mahalanobis_distance(self) -> None:
        colors = torch.rand(2, 3, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        told = standing_out(colors)
        for one, answer in zip(colors.flatten(2).numpy(), told.flatten(1).numpy(), strict=True):
            variance = np.cov(one, bias=True) + LEAST_COLOR_VARIANCE * np.eye(3)
            away = one - one.mean(axis=1, keepdims=True)
            distances = [float(column @ np.linalg.inv(variance) @ column) for column in away.T]
            np.testing.assert_allclose(answer, np.log1p(distances) / 2, rtol=1e-9)


class TestEye:
    def test_two_cubes_in_one_place_are_both_told_and_where_they_are(self) -> None:
        """Places of 8 pixels; cubes of 4, red and blue, side by side in the second place of the first row."""
        picture = torch.full((3, 32, 32), 0.4) + 0.05 * torch.rand(3, 32, 32)
        red, blue = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
        picture[:, 0:4, 8:12] = red[:, None, None]
        picture[:, 0:4, 12:16] = blue[:, None, None]
        spots = VisionEncoder(NetworkSizes(patch_px=8, image_px=32))(picture[None]).spots[0]
        left, right = spots.unflatten(0, (-1, QUARTERS))[1, :2]
        torch.testing.assert_close(left[1:4], 2 * red - 1)
        torch.testing.assert_close(right[1:4], 2 * blue - 1)
        # 16 spots of 2 pixels in a row, from -1 to 1: red covers the fifth and sixth, blue the next two.
        assert left[4] in torch.linspace(-1, 1, 16)[4:6]
        assert right[4] in torch.linspace(-1, 1, 16)[6:8]
        assert left[5] in torch.linspace(-1, 1, 16)[:2]

    def test_spots_lie_in_the_places_in_whose_order_they_are_told(self) -> None:
        spots = VisionEncoder(NetworkSizes(patch_px=8, image_px=32))(torch.rand(1, 3, 32, 32)).spots[0]
        x, y = spots.unflatten(0, (-1, QUARTERS))[..., -2:].unbind(-1)
        column, row = torch.arange(4).repeat(4), torch.arange(4).repeat_interleave(4)  # of 4 by 4 places
        quarter = torch.arange(QUARTERS)
        for told, place, half in ((x, column, quarter % 2), (y, row, quarter // 2)):
            spot = ((told + 1) / 2 * 15).round().long()  # of 16 in a line, two per quarter
            assert torch.equal(spot // 2, 2 * place[:, None] + half)


class TestGoalLayer:
    """Two cameras, the second on the arm, with two look-ups each, one at the left and one at the right."""

    def goals(
        self,
        *,
        unlike: tuple[float, float] = (0.0, 0.0),
        tool_m: tuple[float, float, float] = (0.0, 0.0, 0.3),
        yaw: float = 0.0,
        sure: float = 0.0,
        usual_errors: tuple[float, float] | None = None,
    ) -> Goals:
        """The goals of a tool at a place that points down, turned by so much about the vertical."""
        torch.manual_seed(0)
        layer = GoalLayer(on_arm=(False, True), heads=2)
        with torch.no_grad():
            for each in layer.maps:
                each[-1].weight[0] *= sure  # each place is as sure as any other if it is 0
        if usual_errors is not None:  # as when it acts
            layer.eval().usual_error.copy_(torch.tensor(usual_errors).square())
        places = torch.tensor([[-0.5, 0.2], [0.7, 0.1]]).expand(1, 2, 2, 2)
        evidence = torch.tensor([[0.0, 0.0, -unlike[0]], [0.0, 0.0, -unlike[1]]]).expand(1, 2, 2, 3)
        cos, sin = math.cos(yaw), math.sin(yaw)
        state = torch.tensor([[*tool_m, cos, sin, 0.0, sin, -cos, 0.0, 0.08]])
        return layer(places, evidence, state)

    def test_a_look_up_that_found_something_unlike_is_not_believed(self) -> None:
        left, right = self.goals(unlike=(0.0, 100.0)), self.goals(unlike=(100.0, 0.0))
        both = self.goals(unlike=(1.0, 1.0))
        assert not torch.isclose(left.together, right.together).any()
        torch.testing.assert_close(both.alone, (left.alone + right.alone) / 2)

    def test_the_place_itself_tells_how_sure_its_map_is_there(self) -> None:
        torch.testing.assert_close(self.goals().shares, torch.full((1, 2, 2), 0.5))
        assert self.goals(sure=1e5).shares.amax(dim=-1).min() > 0.99

    @pytest.mark.parametrize(("height_m", "share"), [(0.2, 0.5), (0.4, 0.2), (0.1, 0.8)])
    def test_when_it_acts_cameras_are_weighed_by_the_inverse_of_their_variance(
        self, height_m: float, share: float
    ) -> None:
        """The fixed camera is off by 1 cm, the ray of the other by 5 % of its length: 1 cm at 20 cm."""
        goals = self.goals(tool_m=(0.0, 0.0, height_m), usual_errors=(0.01, 0.05))
        torch.testing.assert_close(goals.camera_shares, torch.tensor([[1 - share, share]]))

    def test_and_less_where_what_they_found_is_less_like_than_usual(self) -> None:
        layer = GoalLayer(on_arm=(False, False), heads=1).eval()
        layer.usual_evidence.copy_(torch.tensor([[1.0, 2.0, -0.5], [1.0, 2.0, -3.0]]))
        for less, share in ((0.0, 0.5), (1.0, 1 / (1 + math.exp(3)))):  # EVIDENCE_COUNTS: e^-3 as much
            evidence = layer.usual_evidence - torch.tensor([[0.0, 0.0, less], [0.0, 0.0, 0.0]])
            goals = layer(torch.zeros(1, 2, 1, 2), evidence[None, :, None], torch.ones(1, 10))
            torch.testing.assert_close(goals.camera_shares[0, 0], torch.tensor(share))

    def test_usual_errors_are_medians_that_rare_large_ones_do_not_move(self) -> None:
        layer = GoalLayer(on_arm=(False, True), heads=1)
        missed = torch.tensor([0.01, 0.02, 0.02, 0.02, 5.0])[:, None, None] * torch.tensor([1.0, 0.0, 0.0])
        state = torch.zeros(5, 10)
        state[:, 2] = 0.4
        for _ in range(400):
            layer.note_errors(missed.expand(5, 2, 3), torch.ones(5, 2, 3), state)
        torch.testing.assert_close(layer.usual_error.sqrt(), torch.tensor([0.02, 0.05]))
        torch.testing.assert_close(layer.usual_evidence, torch.ones(2, 3))

    def test_what_the_camera_on_the_arm_sees_moves_with_the_tool(self) -> None:
        moved = self.goals(tool_m=(0.3, -0.1, 0.3)).alone - self.goals().alone
        torch.testing.assert_close(moved, torch.tensor([[[0.0, 0.0, 0.0], [0.3, -0.1, 0.0]]]))

    def test_and_turns_with_it(self) -> None:
        straight, turned = (self.goals(yaw=yaw).pointed[0] for yaw in (0.0, math.pi / 2))
        assert torch.equal(straight[0], turned[0])
        x, y, up = straight[1].unbind(dim=-1)
        torch.testing.assert_close(turned[1], torch.stack([-y, x, up], dim=-1))

    def test_a_ray_goes_on_as_far_again_from_twice_the_height(self) -> None:
        low, middle, high = (self.goals(tool_m=(0.0, 0.0, z)).pointed[0] for z in (0.1, 0.2, 0.3))
        assert torch.equal(low[0], high[0])
        assert not torch.isclose(low[1, :, :2], high[1, :, :2]).any()
        torch.testing.assert_close(high - middle, middle - low)


class TestActionHead:
    def chunks(self, ways_m: list[list[float]]) -> torch.Tensor:
        torch.manual_seed(0)
        head = ActionHead(hidden=8, chunk=4, action=7, free=False)
        decided = torch.rand(1, 8).expand(len(ways_m), -1)
        actions, _ = head(decided, torch.tensor(ways_m))
        return actions

    def test_what_is_learned_of_one_level_axis_holds_for_the_other(self) -> None:
        first, second = self.chunks([[0.1, -0.03, 0.2], [-0.03, 0.1, 0.2]])
        torch.testing.assert_close(first[:, [1, 0, 2, 3, 4, 5, 6]], second)

    def test_the_way_moves_the_arm_and_nothing_else(self) -> None:
        near, far = self.chunks([[0.01, 0.0, 0.0], [0.2, 0.1, 0.1]])
        assert not torch.isclose(near[:, :3], far[:, :3]).any()
        assert torch.equal(near[:, 3:], far[:, 3:])

    @pytest.mark.parametrize("free", [False, True])
    def test_what_was_decided_bends_the_way_only_where_a_part_of_it_is_free(self, free: bool) -> None:
        torch.manual_seed(0)
        head = ActionHead(hidden=8, chunk=4, action=7, free=free)
        actions, _ = head(torch.rand(2, 8), torch.tensor([[0.1, -0.03, 0.2]] * 2))
        one, other = actions[..., :3]
        assert torch.allclose(torch.linalg.cross(one, other), torch.zeros(4, 3), atol=1e-6) is not free


@pytest.mark.slow
@pytest.mark.parametrize("remembers", [True, False])
def test_it_learns_to_go_where_the_colour_of_the_first_frame_is(remembers: bool) -> None:
    """A square is shown, then nothing, then three squares: the goal is the one of the colour shown."""
    torch.manual_seed(0)
    sizes = NetworkSizes(
        on_arm=(False,), image_px=48, channels=16, heads=4, key=8, memory=64, hidden=64, chunk=1
    )
    network = MemoryNetwork(sizes, remembers=remembers)
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    draws = torch.Generator().manual_seed(1)
    for _ in range(200):
        pictures, goal = recall_episodes(16, draws)
        answer = network(pictures, torch.zeros(*pictures.shape[:2], 10))
        reach = (answer.goal_m[:, -1, :2] - goal).square().mean() / goal.var(dim=0).mean()
        optimizer.zero_grad()
        reach.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    pictures, goal = recall_episodes(100, torch.Generator().manual_seed(2))
    with torch.no_grad():
        told = network(pictures, torch.zeros(*pictures.shape[:2], 10)).goal_m[:, -1, :2]
    share_found = float(((told - goal).norm(dim=-1) < 0.2).float().mean())
    assert share_found > 0.9 if remembers else share_found < 0.5  # 1/3 by guessing


def recall_episodes(n: int, draws: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return pictures (n, 3 steps, 1, 3, 48, 48) and where the right square is, (n, 2) in [-1, 1]."""
    colors = torch.eye(3)
    pictures = torch.full((n, 3, 1, 3, 48, 48), 0.6)
    goal = torch.zeros(n, 2)
    for episode in range(n):
        target = int(torch.randint(3, (1,), generator=draws))
        pictures[episode, 0, 0, :, 20:26, 20:26] = colors[target, :, None, None]
        for color, place in enumerate(torch.randperm(9, generator=draws)[:3].tolist()):
            dx, dy = torch.randint(-2, 3, (2,), generator=draws).tolist()
            x, y = 8 + 14 * (place % 3) + dx, 8 + 14 * (place // 3) + dy
            pictures[episode, 2, 0, :, y : y + 5, x : x + 5] = colors[color, :, None, None]
            if color == target:
                goal[episode] = torch.tensor([x + 2.5, y + 2.5]) / 24 - 1
    return pictures, goal
