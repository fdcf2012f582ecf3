"""Laws of the rotation grid: every rotation has one cell, cells have their stated size, symmetry makes no difference."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest, chi2, kstest
from speed import slow_but

from geomtact.errors import UsageError
from geomtact.geometry.approach import allowed, approach_of, check_approach, facing
from geomtact.geometry.rotations import Directions
from geomtact.geometry.symmetry import Symmetry, about, group_of
from geomtact.se3 import random_rotations, transform

CENTRE = np.array([0.01, -0.02, 0.03])
ONE = np.eye(4)[None]
Z = np.array([0.0, 0.0, 1.0])
TILTED = np.array([0.36, 0.48, 0.8])
ACROSS = np.array([0.8, 0.36, -0.48]) / np.linalg.norm([0.8, 0.36, -0.48])
ACROSS = np.cross(TILTED, ACROSS) / np.linalg.norm(np.cross(TILTED, ACROSS))
HALF_TURN = about(Rotation.from_rotvec([[0, 0, 0], np.pi * ACROSS]).as_matrix(), CENTRE)
SYMMETRIES = {
    "none": Symmetry("none", ONE, None, CENTRE),
    "six turns": Symmetry("discrete", group_of([[0, 0, np.pi / 3]], CENTRE), None, CENTRE),
    "nut": Symmetry("discrete", group_of([[0, 0, np.pi / 3], [np.pi, 0, 0]], CENTRE), None, CENTRE),
    "cube": Symmetry("discrete", group_of([[0, 0, np.pi / 2], [np.pi / 2, 0, 0]], CENTRE), None, CENTRE),
    "axis": Symmetry("axis", ONE, Z, CENTRE),
    "axis with flip": Symmetry("axis", HALF_TURN, TILTED, CENTRE),
    "sphere": Symmetry("sphere", ONE, None, CENTRE),
}
APPROACHES = {
    "all": None,
    "overlapping cones": [((0, 0, 1), 0.5), ((0, 0.3, 1), 0.4), ((1, 0, 0), 0.6)],
    "half": [((1, 1, 1), np.pi / 2)],
}
each_symmetry = pytest.mark.parametrize("symmetry", SYMMETRIES)
each_approach = pytest.mark.parametrize("approach", slow_but(APPROACHES, "all", "half"))


DISKS = {  # disks about faces: none; three, of which two overlap, and one about the axis of those that have one
    "even": None,
    "disks": [
        (v, 0.11) for v in (np.array([0, 0, 1.0]), np.array([0.6, 0.8, 0]), np.array([0.7, 0.7, 0.1]) / 0.99**0.5)
    ],
}
each_grid = pytest.mark.parametrize("disks", DISKS)


@cache
def grid(symmetry, approach="all", level=2, disks="even"):
    return Directions.make(SYMMETRIES[symmetry], APPROACHES[approach], level, disks=DISKS[disks])


def random_poses(n, rng, cones=None):
    T = transform(random_rotations(n, rng), 0.01 * rng.normal(size=(n, 3)))
    return T[allowed(approach_of(T[:, :3, :3]), cones)]


def random_elements(symmetry, n, rng):
    S = symmetry.elements[rng.integers(len(symmetry.elements), size=n)]
    if symmetry.kind == "axis":
        turn = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (n, 1)) * symmetry.axis).as_matrix()
        S = about(turn, CENTRE) @ S
    if symmetry.kind == "sphere":
        S = about(random_rotations(n, rng), CENTRE)
    return S


def cells_of(directions, T):
    _, k, j = directions.lookup(T)
    return np.concatenate([[0], np.cumsum(directions.turns)])[k] + j


def cell_weights(directions):
    return np.repeat(directions.weights / directions.turns, directions.turns)


@each_symmetry
def test_halfway_between_two_turns_the_first_is_taken_whatever_the_last_digit(symmetry):
    """So that every processor looks a pose up alike: rotations of a grid often lie halfway between turns of a coarser one."""
    directions = grid(symmetry)
    k = np.repeat(np.arange(len(directions.vectors)), directions.turns)
    j = np.arange(len(k)) - np.repeat(directions.first_turn, directions.turns)
    halfway = (j + 0.5) * directions.periods[k] / directions.turns[k]
    for off in (-1e-13, 0.0, 1e-13):
        turn = Rotation.from_euler("z", (halfway + off)[:, None]).as_matrix()
        R = turn @ facing(directions.vectors[k])
        assert (directions.lookup(transform(R, np.zeros(3)))[2] == j)[directions.turns[k] > 1].all()


def chi_square(observed, expected):
    """The p-value, cells that expect fewer than five taken together."""
    few = expected < 5
    observed = np.append(observed[~few], observed[few].sum())
    expected = np.append(expected[~few], expected[few].sum())
    some = expected > 0
    assert (observed[~some] == 0).all()
    observed, expected = observed[some], expected[some]
    if len(observed) < 2:
        return 1.0
    return chi2.sf(((observed - expected) ** 2 / expected).sum(), len(observed) - 1)


@pytest.mark.parametrize(("level", "n"), [(1, 576), (2, 4608), (3, 36864)])
def test_complete_levels_have_their_number_of_rotations(level, n):
    directions = grid("none", level=level)
    R, direction, turn = directions.rotations()
    assert len(R) == len(direction) == len(turn) == n
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(R) == pytest.approx(np.ones(n))
    assert cell_weights(directions) == pytest.approx(np.full(n, 1 / n), rel=1e-12)


@each_symmetry
def test_symmetry_saves_what_it_makes_equal(symmetry):
    n = len(grid(symmetry, level=3).rotations()[0])
    kind, order = SYMMETRIES[symmetry].kind, len(SYMMETRIES[symmetry].elements)
    if kind == "sphere":
        assert n == 1
    elif kind == "axis":
        assert n < 36864 / 20
    else:  # cells on the border of the kept region are kept whole
        assert 36864 / order <= n < 1.6 * 36864 / order


@each_symmetry
@each_approach
@each_grid
@pytest.mark.parametrize("level", slow_but([1, 2], 1))
def test_uniform_rotations_fall_into_each_cell_by_its_weight(symmetry, approach, level, disks, rng):
    directions = grid(symmetry, approach, level, disks)
    T = random_poses(30_000, rng, directions.cones)
    expected = cell_weights(directions)
    assert expected.sum() == pytest.approx(1) and directions.weights.sum() == pytest.approx(1)
    observed = np.bincount(cells_of(directions, T), minlength=len(expected))
    assert chi_square(observed, expected * len(T)) > 1e-4


@each_symmetry
@each_approach
@each_grid
@pytest.mark.parametrize("level", slow_but([1, 2], 1))
def test_each_rotation_of_the_grid_lies_in_the_cell_it_represents(symmetry, approach, level, disks):
    directions = grid(symmetry, approach, level, disks)
    R, _, _ = directions.rotations()
    assert allowed(approach_of(R), directions.cones).mean() > 0.9
    assert (cells_of(directions, transform(R, np.zeros(3))) == np.arange(len(R))).all()


@each_symmetry
@each_approach
@each_grid
def test_the_objects_symmetry_changes_neither_cell_nor_canonical_pose(symmetry, approach, disks, rng):
    directions = grid(symmetry, approach, disks=disks)
    T = random_poses(3000, rng, directions.cones)
    image = T @ random_elements(SYMMETRIES[symmetry], len(T), rng)
    both = allowed(approach_of(image[:, :3, :3]), directions.cones)
    assert both.sum() > 50
    T, image = T[both], image[both]
    assert (cells_of(directions, image) == cells_of(directions, T)).all()
    assert np.abs(directions.canonical(image) - directions.canonical(T)).max() < 1e-9
    # the canonical pose is an image itself: it keeps the symmetry's centre where it is
    centre = np.append(CENTRE, 1)
    assert np.abs(directions.canonical(T) @ centre - T @ centre).max() < 1e-12


@each_symmetry
@each_approach
@each_grid
def test_draws_fall_into_their_own_cell(symmetry, approach, disks, rng):
    directions = grid(symmetry, approach, disks=disks)
    n = len(directions.rotations()[0])
    cells = rng.integers(n, size=600)
    R = directions.draw(cells, rng)
    assert (cells_of(directions, transform(R, np.zeros(3))) == cells).all()
    assert allowed(approach_of(R), directions.cones).all()


@pytest.mark.parametrize("name", ["none", "nut", "axis", "axis with flip"])
@each_grid
def test_draws_are_uniform_within_their_cell(name, disks, rng):
    """Cells of a coarse grid drawn by weight hit the cells of a finer grid as uniform rotations do."""
    coarse, fine = grid(name, level=1, disks=disks), grid(name, level=2)
    p = cell_weights(coarse)
    cells = rng.choice(len(p), 20_000, p=p / p.sum())
    R = coarse.draw(cells, rng)
    expected = cell_weights(fine)
    observed = np.bincount(cells_of(fine, transform(R, np.zeros(3))), minlength=len(expected))
    assert chi_square(observed, expected * len(cells)) > 1e-4


@each_symmetry
@each_approach
def test_any_image_is_an_allowed_image_and_they_are_all_met(symmetry, approach, rng):
    directions = grid(symmetry, approach, 1)
    T = random_poses(400, rng, directions.cones)[:1]
    images = directions.any_image(np.repeat(T, 2000, 0), rng)
    assert allowed(approach_of(images[:, :3, :3]), directions.cones).all()
    assert np.abs(directions.canonical(images) - directions.canonical(T)).max() < 1e-9
    kind, elements = SYMMETRIES[symmetry].kind, SYMMETRIES[symmetry].elements
    if kind in ("none", "discrete"):
        found, count = np.unique(images[:, :3, :3].round(6), axis=0, return_counts=True)
        own = T @ elements
        assert len(found) == allowed(approach_of(own[:, :3, :3]), directions.cones).sum()
        assert chi_square(count, np.full(len(count), 2000 / len(count))) > 1e-4
    elif approach == "all":
        assert Rotation.from_matrix(images[:, :3, :3]).mean().magnitude() < np.pi  # no error: they are spread
        assert np.abs(images[:, :3, 0].mean(0)).max() < (0.99 if kind == "axis" else 0.1)


@pytest.mark.parametrize("symmetry", ["none", "six turns", "nut", "cube"])
def test_a_face_has_its_own_small_cell(symmetry, rng):
    """About its normal, a seventh of the disk in area; images of the face have the same one."""
    face, half = np.array([0.54, 0.29, 0.79]) / np.linalg.norm([0.54, 0.29, 0.79]), 0.11  # far from its own images
    directions = Directions.make(SYMMETRIES[symmetry], None, 2, disks=[(face, half)])
    small = half / np.sqrt(7)
    near = transform(facing(within((face, half), 500, rng)), np.zeros(3))
    assert len(np.unique(directions.lookup(near)[1])) == 7
    k = directions.lookup(transform(facing(face)[None], np.zeros(3)))[1][0]
    images = np.einsum("gji,j->gi", SYMMETRIES[symmetry].elements[:, :3, :3], face)
    assert np.linalg.norm(images - directions.vectors[k], axis=1).min() < 1e-9
    order = len(SYMMETRIES[symmetry].elements)
    assert directions.weights[k] == pytest.approx(order * np.sin(half / 2) ** 2 / 7, rel=0.02)
    assert (directions.lookup(transform(facing(within((face, 0.999 * small), 500, rng)), np.zeros(3)))[1] == k).all()


@pytest.mark.parametrize("symmetry", ["none", "six turns"])
@pytest.mark.parametrize("level", slow_but([1, 2], 1))
def test_cones_about_a_face_weigh_what_they_put_into_its_cells(symmetry, level, rng):
    """From far narrower than a cell of the disk to wider than the disk, about its middle and off it."""
    face, disk = np.array([0.54, 0.29, 0.79]) / np.linalg.norm([0.54, 0.29, 0.79]), 0.2 / level
    for half in (3e-4, 5e-3, 0.3 * disk, 0.9 * disk, 1.5 * disk):
        for off in (0, 0.2, 0.8):
            v = face + off * disk * np.cross(face, ACROSS)
            cone = (v / np.linalg.norm(v), half)
            directions = Directions.make(SYMMETRIES[symmetry], [cone], level, disks=[(face, disk)])
            k = cells_in(directions, cone, 4000, rng)
            observed = np.bincount(k, minlength=len(directions.weights))
            assert chi_square(observed, directions.weights * 4000) > 1e-5


@pytest.mark.parametrize("symmetry", ["axis", "axis with flip"])
def test_about_a_symmetry_axis_a_face_has_its_own_two_bands(symmetry):
    sym, half = SYMMETRIES[symmetry], 0.11
    even, finer = (
        Directions.make(sym, None, 2, disks=disks) for disks in (None, [(sym.axis, half), (Z + ACROSS, half)])
    )
    assert len(finer.vectors) == len(even.vectors) + 2  # what is not about the axis is no face that can be turned
    polar = np.arccos(np.clip(finer.vectors @ sym.axis, -1, 1))
    order = np.argsort(polar)
    assert polar[order[0]] < half / np.sqrt(7) < polar[order[1]] < half < polar[order[2]]
    both = len(sym.elements)  # ends that a flip makes one
    inside = both * np.sin(half / 2) ** 2 * np.array([1 / 7, 1])
    assert np.cumsum(finer.weights[order])[:2] == pytest.approx(inside, rel=1e-9)


def test_the_sensor_lies_where_the_approach_points(rng):
    """The membrane is at the sensor's origin, the object on +z: seen from the object the sensor is at R^T (0, 0, -1)."""
    a = rng.normal(size=(50, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    R = facing(a)
    assert np.abs(approach_of(R) - a).max() < 1e-14
    assert np.linalg.det(R) == pytest.approx(np.ones(50))
    # an object at (0, 0, 5 cm): the sensor's origin in object coordinates
    T = transform(R, np.array([0, 0, 0.05]))
    sensor_in_object = np.linalg.inv(T)[:, :3, 3]
    assert np.abs(sensor_in_object - 0.05 * a).max() < 1e-14


def test_cones_hold_what_lies_within_their_angle(rng):
    cones = check_approach([((0, 0, 2), 0.3), ((1, 0, 0), 0.5)])
    a = rng.normal(size=(5000, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    inside = (np.arccos(a[:, 2]) <= 0.3) | (np.arccos(a[:, 0]) <= 0.5)
    assert (allowed(a, cones) == inside).all()
    on_the_face = check_approach([((0, 0, 1), 0.0)])
    tilt = np.array([0, 5e-7, 9e-7, 1.2e-6, 1e-5])
    near = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], 1)
    assert allowed(near, on_the_face).tolist() == [True, True, True, False, False]


@pytest.mark.parametrize(
    ("approach", "message"),
    [
        ([((0, 0, 0), 0.1)], "expected a direction of three numbers"),
        ([((0, 1), 0.1)], "expected a direction of three numbers"),
        ([((0, 0, np.nan), 0.1)], "expected a direction of three numbers"),
        ([((0, 0, 1), -0.1)], "half angle is in radians, 0 to pi"),
        ([((0, 0, 1), 45)], "half angle is in radians, 0 to pi"),
        ([((0, 0, 1), 0), ((0, 1, 0), 0.2)], "cannot be mixed with cones"),
        ([((0, 0, 1), np.nan)], "half angle is in radians, 0 to pi"),
        ([(0, 0, 1)], r"expected \[\(\(x, y, z\), half_angle\)\], .* got \[\(0, 0, 1\)\]"),
        (((0, 0, 1), 0.1), "expected .*half_angle"),
        ([("top", 0.1)], "expected .*half_angle"),
        ([((0, 0, 1), None)], "expected .*half_angle"),
        (np.eye(3), "expected .*half_angle"),
        (0.5, "expected .*half_angle"),
        ([], "an empty list rules out every touch"),
    ],
)
def test_an_approach_that_makes_no_sense_is_refused(approach, message):
    with pytest.raises(UsageError, match=message) as error:
        check_approach(approach)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "faces", "weights", "periods"),
    [
        ("none", [(0, 0, 1), (1, 0, 0)], [1 / 2, 1 / 2], [2 * np.pi, 2 * np.pi]),
        ("none", [(0, 0, 1), (0, 0, 2)], [1], [2 * np.pi]),
        ("nut", [(0, 0, 1)], [1], [np.pi / 3]),
        ("nut", [(0, 0, 1), (0, 0, -1)], [1], [np.pi / 3]),
        ("nut", [(1, 0, 0)], [1], [np.pi]),
        ("nut", [(0, 0, 1), (0, 0, -1), (1, 0, 0)], [2 / 3, 1 / 3], [np.pi / 3, np.pi]),
        ("axis", [(0, 0, 1)], [1], [0]),
        ("axis", [(0, 0, 1), (0, 0, -1)], [1 / 2, 1 / 2], [0, 0]),
        ("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)], [2 / 3, 1 / 3], [2 * np.pi, 0]),
        ("axis with flip", [TILTED, -TILTED], [1], [0]),
        ("axis with flip", [ACROSS, np.cross(TILTED, ACROSS), TILTED], [2 / 3, 1 / 3], [np.pi, 0]),
        ("cube", [(1, 0, 0), (0, -1, 0), (0, 0, 1)], [1], [np.pi / 2]),
        ("sphere", [(0, 0, 1), (1, 0, 0)], [1], [0]),
    ],
)
def test_exact_faces_are_counted_modulo_symmetry(name, faces, weights, periods, rng):
    symmetry = SYMMETRIES[name]
    directions = Directions.make(symmetry, [(f, 0.0) for f in faces], turn_step=0.1)
    assert directions.weights == pytest.approx(weights)
    assert directions.periods == pytest.approx(periods)
    assert (directions.turns == np.maximum(1, np.ceil(np.array(periods) / 0.1 - 1e-9))).all()
    R, _, _ = directions.rotations()
    assert (cells_of(directions, transform(R, np.zeros(3))) == np.arange(len(R))).all()
    # uniform over the faces that the scene allows, each with every turn
    distinct = np.unique([np.array(f) / np.linalg.norm(f) for f in faces], axis=0)
    n = 5000
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (n, 1))).as_matrix()
    T = transform(turn @ facing(distinct[rng.integers(len(distinct), size=n)]), 0.01 * rng.normal(size=(n, 3)))
    expected = cell_weights(directions)
    if symmetry.kind != "sphere":
        assert chi_square(np.bincount(cells_of(directions, T), minlength=len(expected)), expected * n) > 1e-4
    image = T @ random_elements(symmetry, n, rng)
    both = allowed(approach_of(image[:, :3, :3]), directions.cones)
    assert both.any() == (symmetry.kind != "sphere")
    # a pose on the border of two turns may fall to either side by a rounding error
    assert (cells_of(directions, image[both]) != cells_of(directions, T[both])).sum() <= 5


# --- thin cones: each trial is a level, and one cone or two of half angles from 1e-3 to 1 rad


def random_unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def random_cones(rng, count):
    return [(random_unit(rng), half) for half in 10 ** rng.uniform(-3, 0, count)]


def within(cone, n, rng):
    """Directions (n, 3) uniform over a cone, by another method than the grid's: about +z, then mirrored onto the cone."""
    v, half = cone
    angle, turn = 2 * np.arcsin(np.sqrt(rng.random(n)) * np.sin(half / 2)), rng.uniform(0, 2 * np.pi, n)
    a = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], 1)
    w = Z - v
    return a - 2 * np.outer(a @ w, w) / (w @ w)


def cells_in(directions, cone, n, rng):
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (n, 1))).as_matrix()
    return directions.lookup(transform(turn @ facing(within(cone, n, rng)), np.zeros(3)))[1]


@pytest.mark.parametrize("symmetry", [name for name in SYMMETRIES if name != "sphere"])
def test_each_cone_weighs_its_share_of_the_area(symmetry, rng):
    trials = [(4, [(random_unit(rng), 0.005), (random_unit(rng), 0.005)])]
    trials += [(1 + i % 4, random_cones(rng, 2)) for i in range(8)]
    measured = 0
    for level, cones in trials:
        directions = Directions.make(SYMMETRIES[symmetry], cones, level)
        here, there = (set(cells_in(directions, cone, 2000, rng)) for cone in cones)
        if here & there:  # two cones in one cell cannot be distinguished
            continue
        area = np.array([np.sin(half / 2) ** 2 for _, half in cones])
        weight = [directions.weights[allowed(directions.vectors, [cone])].sum() for cone in cones]
        assert weight == pytest.approx(area / area.sum(), rel=0.02)
        measured += 1
    assert measured >= 3


@each_symmetry
def test_cells_weigh_what_overlapping_cones_put_into_them(symmetry, rng):
    for level in range(1, 5):
        (v, half), n = random_cones(rng, 1)[0], 10_000
        beside = v + half * random_unit(rng)
        cones = check_approach([(v, half), (beside, rng.uniform(0.5, 1) * half)])
        directions = Directions.make(SYMMETRIES[symmetry], cones, level)
        area = np.array([np.sin(half / 2) ** 2 for _, half in cones])
        first = rng.binomial(n, area[0] / area.sum())
        a = np.concatenate([within(cones[0], first, rng), within(cones[1], n - first, rng)])
        # what lies in both was drawn by both: the second gives it up
        a = a[(np.arange(n) < first) | ~allowed(a, cones[:1])]
        _, k, _ = directions.lookup(transform(facing(a), np.zeros(3)))
        observed = np.bincount(k, minlength=len(directions.weights))
        assert chi_square(observed, directions.weights * len(a)) > 1e-4


@each_symmetry
@pytest.mark.parametrize("half", [1.0, 0.1, 0.005])
def test_a_cone_within_a_cone_counts_once(symmetry, half, rng):
    v = random_unit(rng)
    one = Directions.make(SYMMETRIES[symmetry], [(v, half)], 3)
    for cones in ([(v, half), (v, half)], [(v, half / 3), (v, half)]):
        two = Directions.make(SYMMETRIES[symmetry], cones, 3)
        assert two.weights == pytest.approx(one.weights, rel=1e-12)
        assert np.abs(two.vectors - one.vectors).max() < 1e-12


@each_symmetry
def test_draws_are_uniform_over_thin_cones(symmetry, rng):
    for trial in range(4):
        cones = random_cones(rng, 1 + trial % 2)
        directions = Directions.make(SYMMETRIES[symmetry], cones, 1 + trial % 4)
        assert allowed(directions.vectors, cones).all()
        p = cell_weights(directions)
        cells = rng.choice(len(p), 800, p=p / p.sum())
        T = transform(directions.draw(cells, rng), np.zeros(3))
        assert allowed(approach_of(T[:, :3, :3]), cones).all()
        if symmetry != "sphere":
            own, k, _ = directions.lookup(T)
            assert (cells_of(directions, T) == cells).all()
            assert np.abs(approach_of(own[:, :3, :3]) - directions.vectors[k]).max(-1).min() > 1e-9
        a = approach_of(directions.any_image(T, rng)[:, :3, :3])
        for v, half in cones:
            inside = a[allowed(a, [(v, half)])]
            assert len(cones) == 2 or len(inside) == len(a)
            if len(inside) > 20:
                sagitta = ((inside - v) ** 2).sum(1) / 2  # 1 - cos, precise at small angles
                assert kstest(sagitta / (1 - np.cos(half)), "uniform").pvalue > 1e-4
                x, y, _ = facing(v)
                turn = np.arctan2(inside @ y, inside @ x)
                assert kstest(turn / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("name", ["axis", "sphere"])
def test_images_of_an_exact_face_are_all_faces_alike(name, rng):
    cones = [((1, 0, 0), 0.0), ((0, 1, 0), 0.0)]
    directions = Directions.make(SYMMETRIES[name], cones)
    T = transform(np.repeat(facing([[1.0, 0, 0]]), 2000, 0), 0.01 * rng.normal(size=(2000, 3)))
    a = approach_of(directions.any_image(T, rng)[:, :3, :3])
    assert allowed(a, directions.cones).all()
    assert binomtest(int((a[:, 0] > 0.5).sum()), 2000).pvalue > 1e-4


@pytest.mark.parametrize("approach", APPROACHES)
@pytest.mark.parametrize("symmetry", [name for name in SYMMETRIES if name != "sphere"])
def test_the_density_times_the_volume_is_the_share_of_rotations_there(symmetry, approach, rng):
    """Within 4.5 standard errors: about one rotation, modulo the symmetry, of all that are allowed."""
    sym, cones = SYMMETRIES[symmetry], check_approach(APPROACHES[approach])
    directions = Directions.make(sym, APPROACHES[approach], 1)
    R = random_rotations(200_000, rng)
    R = R[allowed(approach_of(R), cones)]
    middle = facing(np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0]) if cones is None else cones[0][0])
    angle = 0.3
    if sym.axis is not None:
        flips = sym.elements[:, :3, :3] @ sym.axis
        near = ((R @ flips.T).transpose(0, 2, 1) @ middle @ sym.axis).max(1) > np.cos(angle)
        volume = 2 * np.pi * (1 - np.cos(angle))
    else:
        trace = np.einsum("ij,njk,eki->ne", middle.T, R, sym.elements[:, :3, :3]).max(1)
        near = trace > 1 + 2 * np.cos(angle)
        volume = 8 * np.pi * (angle - np.sin(angle))
    # draws come with the density: the mean of its inverse over them is the volume over their share
    found = np.sum(1 / directions.density(R[near])) / len(R)
    assert found == pytest.approx(volume, rel=4.5 / np.sqrt(near.sum()))


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_motions_are_all_but_the_symmetries(symmetry):
    """A motion moves points of the object to where no symmetry brings them, each as far as the others."""
    sym = SYMMETRIES[symmetry]
    motions = sym.motions
    assert motions.shape == ({"axis": 5, "sphere": 3}.get(sym.kind, 6), 6)
    turns = motions[motions[:, :3].any(1)]
    np.testing.assert_allclose(turns[:, :3] @ turns[:, :3].T, np.eye(len(turns)), atol=1e-12)
    if sym.axis is not None:
        np.testing.assert_allclose(turns[:, :3] @ sym.axis, 0, atol=1e-12)
        np.testing.assert_allclose(np.cross(turns[:, :3], CENTRE) + turns[:, 3:], 0, atol=1e-12)


def test_the_density_is_finite_on_exact_faces(rng):
    directions = Directions.make(SYMMETRIES["nut"], [((0, 0, 1), 0.0)])
    assert np.isfinite(directions.density(random_rotations(5, rng))).all()
