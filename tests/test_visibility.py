"""What one state's photographs say of a point."""

from dataclasses import replace

import numpy as np
import pytest

from hingesplat.gaussians import Gaussians, concatenate
from hingesplat.stereo import DepthMap, fused, measured
from hingesplat.visibility import COLOUR, FREE, HIDDEN, SURFACE, Sight, ask, look, sides
from scenes import box, cameras_around, look_at, off_boards, open_box, photograph, sheet, texture

SIZE = 96
TOLERANCE = 0.03
CENTRES = np.vstack([np.diag([0.5, 0.3, 0.4]), -np.diag([0.5, 0.3, 0.4])])
"""Of the box's faces: where it is seen squarely."""


@pytest.fixture(scope="module")
def solid() -> Gaussians:
    return box((-0.5, -0.3, -0.4), (0.5, 0.3, 0.4), 0.04, seed=1)


@pytest.fixture(scope="module")
def sight(solid: Gaussians) -> Sight:
    return look(solid, [photograph(solid, c) for c in cameras_around(16, SIZE)], SIZE, TOLERANCE)


def answer(points: np.ndarray, sight: Sight) -> np.ndarray:
    return ask(points, texture(points, 1), sight)


def test_points_on_the_surface_are_seen_or_hidden_not_free(sight: Sight) -> None:
    a = answer(CENTRES, sight)
    assert (a[:, FREE] <= 1).all()  # A glancing view may err.
    assert (a[:, SURFACE] >= 2).all() and (a[:, HIDDEN] >= 2).all()
    assert (a[:, :3].sum(1) == 16).all()


def test_points_in_front_are_free_where_the_face_is_seen(sight: Sight) -> None:
    on, front = answer(CENTRES, sight), answer(1.4 * CENTRES, sight)
    assert (front[:, SURFACE] == 0).all()
    assert (front[:, FREE] >= on[:, SURFACE]).all()


def test_points_inside_are_hidden_from_everywhere(sight: Sight) -> None:
    inside = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3)) * [0.5, 0.3, 0.4]
    a = answer(inside, sight)
    assert (a[:, HIDDEN] == 16).all()


def test_points_beside_the_mask_are_free(sight: Sight, solid: Gaussians) -> None:
    above = np.array([[0.0, 0.0, 0.7], [0.3, 0.1, 0.6]])
    level = [photograph(solid, look_at(np.array([x, y, 0.0]), SIZE)) for x, y in ((0.0, -3.0), (3.0, 0.0), (-3.0, 0.0))]
    a = answer(above, look(solid, level, SIZE, TOLERANCE))
    assert (a[:, FREE] == 3).all() and (a[:, COLOUR] == 0).all()
    assert (answer(above, sight)[:, FREE] >= 8).all()


def test_a_pixel_is_the_objects_if_more_than_half_of_it_is(solid: Gaussians) -> None:
    """Half of it is not: at half the size every other edge would grow by half a pixel."""
    view = photograph(solid, cameras_around(1, SIZE)[0])
    for share, known in ((0.5, False), (0.75, True)):
        alpha = np.zeros((SIZE, SIZE), np.uint8)
        alpha[::2, ::2] = alpha[1::2, 1::2] = 255
        alpha[1::2, ::2] = 255 * (share > 0.5)
        rgba = np.concatenate([view.rgba[..., :3], alpha[..., None]], -1)
        depth = look(solid, [replace(view, rgba=rgba)], SIZE // 2, TOLERANCE).depth
        assert (depth != 0).all() == known and (depth != 0).any() == known


def test_who_stands_out_of_every_picture_gets_no_answer(solid: Gaussians) -> None:
    one = photograph(solid, look_at(np.array([0.0, -3.0, 0.0]), SIZE))
    behind, aside = [0.0, -4.0, 0.0], [4.0, 0.0, 0.0]
    a = answer(np.array([behind, aside]), look(solid, [one], SIZE, TOLERANCE))
    assert (a == 0).all()


def test_the_right_colour_differs_little_and_a_wrong_one_much(sight: Sight) -> None:
    right = answer(CENTRES, sight)[:, COLOUR]
    wrong = ask(CENTRES, 1 - texture(CENTRES, 1), sight)[:, COLOUR]
    assert right.max() < 0.15
    assert (wrong > 2 * right).all()


def test_a_point_shows_the_side_from_which_it_is_seen_whose_colour_counts(sight: Sight) -> None:
    """Whichever way its normal points. A door's inside has not the colour that cameras in front of the door see."""
    outward = np.sign(CENTRES) * (CENTRES != 0)
    for normals in (outward, -outward):
        facing = sides(CENTRES, normals, sight)
        assert ((facing * outward).sum(1) > 0.9).all()
    wrong = 1 - texture(CENTRES, 1)
    either, known, turned = (ask(CENTRES, wrong, sight, side) for side in (None, facing, -facing))
    np.testing.assert_array_equal(known, either)
    np.testing.assert_array_equal(turned[:, :COLOUR], either[:, :COLOUR])
    # Only a glancing view may be on either side.
    assert (turned[:, COLOUR] == 0).sum() >= 5 and (either[:, COLOUR] > 0.1).all()


def test_a_plate_seen_from_both_sides_in_one_point_has_no_side() -> None:
    points = np.array([[0.0, 0.0, 0.0]])
    plate = box((-0.5, -0.005, -0.4), (0.5, 0.005, 0.4), 0.04, seed=1)
    views = [photograph(plate, look_at(np.array([0.3, y, 0.0]), SIZE)) for y in (-3.0, 3.0)]
    both = look(plate, views, SIZE, TOLERANCE)
    assert np.abs(sides(points, np.array([[0.0, 1.0, 0.0]]), both)).max() < 0.05


def test_a_mask_without_gaussians_is_no_free_space(solid: Gaussians) -> None:
    """Where the photograph shows the object and the render nothing, depth is unknown, not empty."""
    cameras = cameras_around(16, SIZE)
    views = [photograph(solid, c) for c in cameras]
    half = solid[solid.means[:, 0] < 0]
    a = answer(np.array([[0.35, -0.3, 0.0], [0.35, 0.3, 0.0]]), look(half, views, SIZE, TOLERANCE))
    assert (a[:, FREE] <= 2).all()


def test_a_floater_beside_the_photographed_object_makes_no_surface(solid: Gaussians) -> None:
    views = [photograph(solid, c) for c in cameras_around(16, SIZE)]
    lump = solid[solid.means[:, 0] > 0.49]
    lump.means = lump.means + lump.means.new_tensor([0.4, 0.0, 0.0])
    a = answer(lump.means.numpy(), look(lump, views, SIZE, TOLERANCE))
    assert (a[:, FREE] > a[:, SURFACE]).mean() > 0.9


def test_look_keeps_each_cameras_shape_and_shrinks_to_the_size(solid: Gaussians) -> None:
    tall = replace(look_at(np.array([0.0, -3.0, 0.5]), 64), height=128)
    views = [photograph(solid, c) for c in (look_at(np.array([0.0, -3.0, 0.5]), 64), tall)]
    sight = look(solid, views, 64, TOLERANCE)
    assert sight.depth.shape == (2, 64, 32)  # Both by half, the first with empty rows below.
    assert (sight.depth[0, 32:] == 0).all() and (sight.rgb[0, 32:] == 1).all()
    assert (sight.depth[:, :32] > 0).any((1, 2)).all()
    for P, view in zip(sight.P, views, strict=True):
        h = CENTRES @ P[:, :3].T + P[:, 3]
        np.testing.assert_allclose(2 * h[:, :2] / h[:, 2:], view.camera.project(CENTRES)[0], rtol=1e-4)


# With depth that is known.


def boxed_in() -> Gaussians:
    """The open box as a careless fit would have it: with a lid."""
    cloud = fused(measured(open_box(SIZE), SIZE), 0.04)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.45, 0.45, 24), np.linspace(-0.35, 0.35, 18)))
    lid = np.column_stack([x, y, np.full(x.shape, 0.4)])
    return concatenate(
        [
            sheet(cloud.points, cloud.normals, cloud.colours, 0.03),
            sheet(lid, np.tile([0.0, 0, 1], (len(lid), 1)), np.full(lid.shape, 0.5), 0.03),
        ]
    )


def unknown(maps: list[DepthMap], every: int) -> list[DepthMap]:
    """Nothing is known of each ``every``-th photograph."""
    return [replace(m, depth=np.zeros_like(m.depth)) if i % every == 0 else m for i, m in enumerate(maps)]


IN_THE_HOLLOW = np.random.default_rng(0).uniform(-1, 1, (40, 3)) * [0.35, 0.25, 0.1] + [0, 0, 0.1]


def test_known_depth_wins_over_what_is_rendered() -> None:
    views = open_box(SIZE)
    maps = measured(views, SIZE)
    plain, knowing = look(boxed_in(), views, SIZE, TOLERANCE), look(boxed_in(), views, SIZE, TOLERANCE, maps)
    for before, after, m in zip(plain.depth, knowing.depth, maps, strict=True):
        known = (before != 0) & (m.depth > 0)
        np.testing.assert_array_equal(after[known], m.depth[known])
        assert (after[before == 0] == 0).all()  # The photograph has the last word on the mask.
    assert (answer(IN_THE_HOLLOW, plain)[:, HIDDEN] >= 10).all()
    assert (answer(IN_THE_HOLLOW, knowing)[:, FREE] >= 8).all()


def test_known_depth_is_looked_up_at_the_sights_size() -> None:
    views = open_box(SIZE)
    maps = measured(views, SIZE)
    sight = look(boxed_in(), views, SIZE // 2, TOLERANCE, maps)
    known = (sight.depth[0] != 0) & (maps[0].depth[1::2, 1::2] > 0)
    np.testing.assert_array_equal(sight.depth[0][known], maps[0].depth[1::2, 1::2][known])


def test_nothing_is_said_where_others_see_through_what_is_rendered() -> None:
    views = open_box(SIZE)
    maps = unknown(measured(views, SIZE), 3)
    plain, knowing = look(boxed_in(), views, SIZE, TOLERANCE), look(boxed_in(), views, SIZE, TOLERANCE, maps)
    for i in range(0, 9, 3):  # From high above, where the lid fills the view of the hollow.
        camera = views[i].camera
        y, x = np.nonzero(plain.depth[i] > 0)
        before, after = plain.depth[i][y, x], knowing.depth[i][y, x]
        points = camera.lifted(x, y, before)
        lid = (np.abs(points - [0, 0, 0.4]) < [0.3, 0.2, 0.02]).all(1)
        assert lid.sum() > 50 and (after[lid] == -1).mean() > 0.95


def test_a_surface_that_nobody_sees_through_stays() -> None:
    views = open_box(SIZE)
    maps = unknown(measured(views, SIZE), 3)
    plain, knowing = look(boxed_in(), views, SIZE, TOLERANCE), look(boxed_in(), views, SIZE, TOLERANCE, maps)
    for i in (18, 21):  # From the side.
        y, x = np.nonzero(plain.depth[i] > 0)
        before, after = plain.depth[i][y, x], knowing.depth[i][y, x]
        points = views[i].camera.lifted(x, y, before)
        outer = (np.abs(points[:, :2]) > [0.48, 0.38]).any(1) & (off_boards(points) < 0.01)
        assert outer.sum() > 150 and (after[outer] == before[outer]).mean() > 0.85


def test_maps_that_know_nothing_change_nothing() -> None:
    views = open_box(SIZE)[::4]
    nothing = unknown(measured(views, SIZE), 1)
    plain, same = look(boxed_in(), views, SIZE, TOLERANCE), look(boxed_in(), views, SIZE, TOLERANCE, nothing)
    np.testing.assert_array_equal(plain.depth, same.depth)
    np.testing.assert_array_equal(plain.rgb, same.rgb)


def test_a_mask_without_gaussians_gets_the_depth_that_is_known() -> None:
    views = open_box(SIZE)[:2]
    maps = measured(views, SIZE)
    far = boxed_in()
    far.means = far.means + 50
    assert set(np.unique(look(far, views, SIZE, TOLERANCE).depth)) == {-1, 0}
    sight = look(far, views, SIZE, TOLERANCE, maps)
    seen = maps[0].depth > 0
    np.testing.assert_array_equal(sight.depth[0][seen], maps[0].depth[seen])
