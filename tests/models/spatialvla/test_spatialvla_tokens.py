"""Action grids and tokens of SpatialVLA: the original's numbers, round trips, a grid that is fitted anew."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.models.spatialvla import spatialvla_golden as golden
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.models.shared.gripper import Gripper
from vla_eval.models.shared.network_sizes import with_changes
from vla_eval.models.spatialvla.action_grid import (
    AXES,
    LEAST_SIGMA,
    ActionGrid,
    fitted_gaussians,
    from_spherical,
    refitted,
    to_spherical,
    uniform_grid,
)
from vla_eval.models.spatialvla.generation import from_tokens, to_tokens
from vla_eval.models.spatialvla.sizes import NetworkSizes

SIZES = golden.SIZES
GRIDS = [
    ("uniform", "act.uniform_bins"),
    ("gaussian", "act.gaussian_bins"),
    ("adapted_gaussian", "adapt.bins"),
]
TRANSLATIONS = slice(0, SIZES.n_translations)
ROTATIONS = slice(SIZES.n_translations, SIZES.n_translations + SIZES.n_rotations)


def grid_of(name: str) -> ActionGrid:
    return uniform_grid(SIZES.n_bins) if name == "uniform" else golden.grid(name)


class TestGrid:
    @pytest.mark.parametrize(("name", "prefix"), GRIDS)
    def test_edges_are_the_originals(self, name: str, prefix: str) -> None:
        for axis, edges in zip(AXES, grid_of(name).edges, strict=True):
            expected = golden.values()[f"{prefix}.{axis}_bins"].numpy()
            np.testing.assert_allclose(edges, expected, atol=1e-12, rtol=0)

    def test_bins_of_a_gaussian_are_equally_likely(self) -> None:
        edges = golden.grid().edges[AXES.index("roll")]
        mu, sigma = golden.config()["action_tokens"]["gaussian"]["roll"].values()
        draws = np.random.default_rng(0).normal(mu, sigma, 40_000)
        counts, _ = np.histogram(draws[np.abs(draws) < 1], np.array(edges))
        assert counts / counts.sum() == pytest.approx([1 / SIZES.roll_bins] * SIZES.roll_bins, abs=0.01)

    def test_what_is_fitted_is_mean_and_deviation_of_each_axis(self) -> None:
        actions = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (500, 7)))
        fitted = fitted_gaussians(actions)
        phi = np.arctan2(actions[:, 1], actions[:, 0]).numpy()
        assert fitted["phi"] == pytest.approx((phi.mean(), phi.std()))
        r = np.linalg.norm(actions[:, :3].numpy(), axis=1)
        assert fitted["r"] == pytest.approx((r.mean(), r.std()))
        assert fitted["yaw"] == pytest.approx((float(actions[:, 5].mean()), actions[:, 5].numpy().std()))

    def test_a_rotation_that_never_happens_has_the_narrowest_bins_and_a_grid_all_the_same(self) -> None:
        actions = torch.rand(50, 7, dtype=torch.float64)
        actions[:, 4] = 0.0
        fitted = fitted_gaussians(actions)
        assert fitted["pitch"] == (0.0, LEAST_SIGMA)

    def test_nothing_to_fit_to_is_an_error(self) -> None:
        with pytest.raises(RecipeError, match="found none"):
            fitted_gaussians(torch.zeros(0, 7))

    def test_edges_that_do_not_cover_an_axis_are_refused(self) -> None:
        edges = list(uniform_grid(SIZES.n_bins).edges)
        edges[2] = (0.0, 0.5, 1.0)
        with pytest.raises(RecipeError, match=r"'r' must rise from 0 to 1\.73205"):
            ActionGrid(edges=tuple(edges))

    def test_spherical_and_back(self) -> None:
        # z axis: theta 0; x: theta a quarter turn, phi 0; y: phi a quarter turn.
        points = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
        quarter = math.pi / 2
        expected = torch.tensor([[0.0, 0.0, 2.0], [quarter, 0.0, 1.0], [quarter, quarter, 3.0]])
        torch.testing.assert_close(to_spherical(points), expected)
        torch.testing.assert_close(from_spherical(expected), points, atol=1e-6, rtol=0)


class TestTokens:
    @pytest.mark.parametrize("name", ["uniform", "gaussian"])
    def test_there_back_and_there_again_are_the_originals(self, name: str) -> None:
        values, grid = golden.values(), grid_of(name)
        ids = to_tokens(values["act.actions"], grid, SIZES)
        assert torch.equal(ids, values[f"act.{name}.ids"])
        decoded = from_tokens(ids, grid, SIZES)
        torch.testing.assert_close(decoded, values[f"act.{name}.decoded"], atol=1e-12, rtol=0)
        assert torch.equal(to_tokens(decoded, grid, SIZES), values[f"act.{name}.ids_again"])

    def test_every_token_in_every_column_is_decoded_as_the_original_does(self) -> None:
        ids = torch.arange(SIZES.first_action_token, SIZES.vocabulary)[:, None].expand(-1, 3)
        decoded = from_tokens(ids, golden.grid(), SIZES)
        torch.testing.assert_close(decoded, golden.values()["act.gaussian.decode_all"], atol=1e-12, rtol=0)

    def test_training_tokens_are_the_originals_labels(self) -> None:
        values = golden.values()
        ids = to_tokens(values["in.actions"][:2], golden.grid(), SIZES).flatten(1)
        labels = values["train.img1.labels"]
        expected = [row[row != -100][:-1].tolist() for row in labels]  # the last is stop
        assert ids.tolist() == expected

    def test_the_published_grid_has_8194_tokens_behind_the_words(self) -> None:
        sizes = NetworkSizes()
        assert (sizes.n_translations, sizes.n_rotations, sizes.n_action_tokens) == (4096, 4096, 8194)
        assert sizes.vocabulary == 265_347
        open_gripper = torch.tensor([1.0, 1, 1, 1, 1, 1, 1])
        last = to_tokens(open_gripper, uniform_grid(sizes.n_bins), sizes)
        assert last[1:].tolist() == [257153 + 8191, 265_346]

    @pytest.mark.parametrize(
        ("maniskill", "token", "executed"), [(-1.0, 0, -1.0), (-0.1, 0, -1.0), (0.1, 1, 1.0), (1.0, 1, 1.0)]
    )
    def test_maniskills_gripper_is_mapped_before_the_threshold_and_after(
        self, maniskill: float, token: int, executed: float
    ) -> None:
        gripper, action = Gripper(encoding="unit_open"), torch.zeros(7)
        action[-1] = maniskill
        ids = to_tokens(gripper.encode(action), golden.grid(), SIZES)
        assert int(ids[-1]) == SIZES.vocabulary - 2 + token
        assert float(gripper.decode(from_tokens(ids, golden.grid(), SIZES))[-1]) == executed

    def test_a_gripper_that_is_not_mapped_never_closes(self) -> None:
        # The trap: 0, which the tokens say for "closed", is half open to ManiSkill.
        closed = torch.tensor([0.0, 0, 0, 0, 0, 0, -1])
        assert float(from_tokens(to_tokens(closed, golden.grid(), SIZES), golden.grid(), SIZES)[-1]) == 0.0


class TestRefit:
    def test_nothing_moves_on_the_same_grid(self) -> None:
        table = golden.original_weights()["spatial_embed_tokens.weight"]
        torch.testing.assert_close(refitted(table, golden.grid(), golden.grid()), table)

    def test_rows_that_tell_where_they_are_tell_where_they_have_come_to(self) -> None:
        # A table whose rows are the middles themselves is linear: the new one holds the new middles, as far
        # as the old ones reached.
        old, new = golden.grid(), golden.grid("adapted_gaussian")

        def table(grid: ActionGrid) -> Tensor:
            cubes = [
                torch.stack(torch.meshgrid(*[grid.centres(axis) for axis in axes], indexing="ij"), -1)
                for axes in (range(3), range(3, 6))
            ]
            return torch.cat([cube.reshape(-1, 3) for cube in cubes])

        rows = torch.cat([table(old), torch.full((2, 3), 9.0)])
        moved = refitted(rows, old, new)
        for part, axes in ((TRANSLATIONS, range(3)), (ROTATIONS, range(3, 6))):
            low = torch.tensor([float(old.centres(axis)[0]) for axis in axes], dtype=torch.float64)
            high = torch.tensor([float(old.centres(axis)[-1]) for axis in axes], dtype=torch.float64)
            torch.testing.assert_close(moved[part], table(new)[part].clamp(low, high))
        assert torch.equal(moved[-2:], rows[-2:])  # the gripper

    def test_the_original_interpolates_between_the_same_middles_but_takes_roll_for_pitch(self) -> None:
        """Its triangulation is one of many; what all of them share is where the interpolated point is."""
        table = golden.original_weights()["spatial_embed_tokens.weight"][ROTATIONS].double()
        theirs = golden.values()["adapt.spatial_embed_tokens"][ROTATIONS].double()
        shares = torch.linalg.solve(table.T, theirs.T).T  # as many rows as numbers: unique
        old, new = golden.grid(), golden.grid("adapted_gaussian")

        def points(grid: ActionGrid) -> Tensor:
            # Row n as if pitch, not roll, counted slowest.
            roll, pitch, yaw = (grid.centres(axis) for axis in (3, 4, 5))
            pitches, rolls, yaws = torch.meshgrid(pitch, roll, yaw, indexing="ij")
            return torch.stack([rolls, pitches, yaws], dim=-1).reshape(-1, 3)

        low, high = points(old).amin(dim=0), points(old).amax(dim=0)
        torch.testing.assert_close(shares @ points(old), points(new).clamp(low, high), atol=1e-4, rtol=0)
        torch.testing.assert_close(
            shares.sum(dim=1), torch.ones(SIZES.n_rotations, dtype=torch.float64), atol=1e-4, rtol=0
        )

    def test_another_number_of_bins_is_an_error(self) -> None:
        other = uniform_grid((*SIZES.n_bins[:-1], SIZES.n_bins[-1] + 1))
        with pytest.raises(RecipeError, match="cannot be moved"):
            refitted(torch.zeros(SIZES.n_action_tokens, 2), golden.grid(), other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lm_width": 64}, "Did you mean 'llm_width'"),
        ({"image_px": 60}, "multiple of 14"),
        ({"depth_layers": 6}, "multiple of 4"),
        ({"roll_bins": 1}, "2 or more"),
        ({"first_action_token": 40}, "beyond all other tokens"),
    ],
)
def test_sizes_that_cannot_be_are_named(changes: dict[str, int], message: str) -> None:
    with pytest.raises(UnknownNameError if "Did you mean" in message else RecipeError, match=message):
        with_changes(NetworkSizes, changes)
