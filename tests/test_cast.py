"""Laws of simulated contact: balls with a contact in closed form, and rays traced one triangle at a time."""

import numpy as np
import pytest
import trimesh

from geomtact.geometry.mesh_file import load_mesh
from geomtact.se3 import apply, random_rotations, transform
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

MM = 1e-3
ORTHOGRAPHIC = Sensor("orthographic", (320, 240), (6e-5, 5e-5), 0.0, 2.5 * MM)
PERSPECTIVE = Sensor("perspective", (320, 240), (6e-5, 5e-5), 20 * MM, 2.5 * MM)
WIDE_ANGLE = Sensor("wide angle", (320, 240), (6e-5, 5e-5), 6 * MM, 2.5 * MM)
CURVED = Sensor("curved", (320, 240), (6e-5, 5e-5), 20 * MM, 2 * MM, 30 * MM)
CURVED_ORTHOGRAPHIC = Sensor("curved orthographic", (320, 240), (6e-5, 5e-5), 0.0, 2 * MM, 30 * MM)
SENSORS = {s.name: s for s in (ORTHOGRAPHIC, PERSPECTIVE, WIDE_ANGLE, CURVED, CURVED_ORTHOGRAPHIC)}
each_sensor = pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)


def ball(radius):
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return Caster(mesh.vertices, mesh.faces)


def box(extents, centre=(0, 0, 0)):
    mesh = trimesh.creation.box(extents)
    return Caster(mesh.vertices + centre, mesh.faces)


def at(x, y, z):
    return transform(np.eye(3), [x, y, z])


def contact_radius(sensor, R, d):
    """Radius [m] at z = 0 of what the camera sees of a ball of radius R pressed d deep at the centre.

    Of every circle that the ball cuts, from the membrane to its deepest point, the one seen largest.
    """
    zc = R - d
    if sensor.membrane_radius:
        M = sensor.membrane_radius
        along = ((M + zc) ** 2 + M**2 - R**2) / (2 * (M + zc))
        top = along - M
    else:
        top = 0.0
    z = np.linspace(-d, top, 20_001)
    circle = np.sqrt(np.maximum(0, R**2 - (z - zc) ** 2))
    D = sensor.camera_distance
    return (circle * (D / (D + z) if D else 1)).max()


@each_sensor
@pytest.mark.parametrize(("R", "d"), [(6 * MM, 0.3 * MM), (6 * MM, 1.0 * MM), (3 * MM, 1.9 * MM)])
def test_a_pressed_ball_touches_a_disk_of_known_size(sensor, R, d):
    contact = ball(R).contact(sensor, at(0, 0, R - d))
    area = contact.mask.sum() * np.prod(sensor.pixel_pitch)
    assert area == pytest.approx(np.pi * contact_radius(sensor, R, d) ** 2, rel=0.01)
    if sensor is ORTHOGRAPHIC or sensor is PERSPECTIVE:
        assert area == pytest.approx(np.pi * (2 * R * d - d**2), rel=0.01)


def test_a_wide_angle_camera_sees_the_limb_of_a_deep_ball():
    """Where the rays graze the ball below the membrane, the contact looks larger than the circle at z = 0."""
    R, d = 3 * MM, 2.45 * MM
    contact = ball(R).contact(WIDE_ANGLE, at(0, 0, R - d))
    D, zc = WIDE_ANGLE.camera_distance, R - d
    cone = np.arcsin(R / (D + zc))  # half angle of the cone from the camera that touches the ball
    area = contact.mask.sum() * np.prod(WIDE_ANGLE.pixel_pitch)
    assert D * np.tan(cone) > 1.02 * np.sqrt(2 * R * d - d**2)
    assert area == pytest.approx(np.pi * (D * np.tan(cone)) ** 2, rel=0.01)


def test_a_ball_meets_a_curved_membrane_on_the_circle_where_the_spheres_cut():
    R, M, d = 5 * MM, 30 * MM, 1 * MM
    contact = ball(R).contact(CURVED_ORTHOGRAPHIC, at(0, 0, R - d))
    # centres of the spheres are R + M - d apart; Heron's formula gives the height of the triangle (R, M, R + M - d)
    c = R + M - d
    s = (R + M + c) / 2
    radius = 2 * np.sqrt(s * (s - R) * (s - M) * (s - c)) / c
    assert contact.mask.sum() * np.prod(CURVED_ORTHOGRAPHIC.pixel_pitch) == pytest.approx(np.pi * radius**2, rel=0.01)
    assert contact.height.max() == pytest.approx(d, abs=2e-6)


@each_sensor
def test_height_is_depth_along_z_where_each_ray_meets_the_ball(sensor):
    R, centre = 6 * MM, np.array([1.2 * MM, -0.7 * MM, 5 * MM])
    contact = ball(R).contact(sensor, at(*centre))
    x, y = (c.ravel() for c in np.meshgrid(*sensor.pixel_centres()))
    D = sensor.camera_distance
    start = np.stack([0 * x, 0 * x, 0 * x - D], 1) if D else np.stack([x, y, 0 * x - 1], 1)
    ray = np.stack([x, y, 0 * x], 1) - start if D else np.tile([0.0, 0, 1], (len(x), 1))
    a, b = (ray**2).sum(1), ((start - centre) * ray).sum(1)
    c = ((start - centre) ** 2).sum(1) - R**2
    hits = b**2 > a * c
    t = (-b - np.sqrt(np.where(hits, b**2 - a * c, 0))) / a
    p = start + t[:, None] * ray
    M = sensor.membrane_radius
    membrane = np.sqrt(np.maximum(0, M**2 - p[:, 0] ** 2 - p[:, 1] ** 2)) - M if M else 0
    depth = np.where(hits, membrane - p[:, 2], -1)
    height = np.maximum(depth, 0).reshape(contact.height.shape)
    assert np.abs(contact.height - height).max() < 2e-5
    assert np.median(np.abs(contact.height - height)[height > 0]) < 3e-6
    clear = np.abs(depth) > 2e-5
    assert (contact.mask.ravel() == (depth > 0))[clear].all()
    assert (contact.height[~contact.mask] == 0).all() and (contact.height >= 0).all()


@each_sensor
@pytest.mark.parametrize("shift", [(0, 0), (4 * MM, 0), (-3 * MM, 2.5 * MM)])
def test_penetration_is_how_deep_the_ball_is_pressed(sensor, shift, rng):
    """On a curved membrane depth is still counted along z: the deepest point is searched for here by brute force."""
    R, d = 4 * MM, 0.9 * MM
    T = transform(random_rotations(4, rng), np.array([*shift, R - d]))
    s = np.linspace(-R, R, 801)
    X, Y = np.meshgrid(shift[0] + s, shift[1] + s)
    under = R**2 - (X - shift[0]) ** 2 - (Y - shift[1]) ** 2
    Z = np.where(under > 0, (R - d) - np.sqrt(np.maximum(under, 0)), np.inf)
    inside = (np.abs(sensor.project(np.stack([X, Y, np.minimum(Z, 1)], -1))) <= sensor.half_window).all(-1)
    depth = (-Z - sensor.sag(X, Y))[inside].max()
    assert ball(R).penetration(sensor, T) == pytest.approx(np.full(4, depth), abs=5e-6)


@pytest.mark.parametrize("beyond", [0.2, 1.0, 2.0])
def test_a_ball_beside_the_window_touches_its_border(beyond):
    """Only what lies in the window counts, so the deepest point is on the border."""
    R, half = 4 * MM, ORTHOGRAPHIC.half_window[0]
    pressed = ball(R).penetration(ORTHOGRAPHIC, at(half + beyond * MM, 0, R - 2 * MM)[None])[0]
    assert pressed == pytest.approx(np.sqrt(R**2 - (beyond * MM) ** 2) - (R - 2 * MM), abs=1e-5)


def test_nothing_in_the_window_is_minus_infinity_and_a_lifted_object_negative():
    caster = ball(4 * MM)
    for sensor in SENSORS.values():
        assert caster.penetration(sensor, at(50 * MM, 0, 3 * MM)[None])[0] == -np.inf
        lifted = caster.penetration(sensor, at(0, 0, 4.5 * MM)[None])[0]
        assert lifted == pytest.approx(-0.5 * MM, abs=5e-6)
        assert not caster.contact(sensor, at(0, 0, 4.5 * MM)).mask.any()


def test_a_camera_inside_the_object_is_plus_infinity():
    caster = box((60 * MM, 60 * MM, 60 * MM))
    for sensor in (PERSPECTIVE, WIDE_ANGLE, CURVED):
        assert caster.penetration(sensor, at(0, 0, 0)[None])[0] == np.inf
    assert caster.penetration(PERSPECTIVE, at(0, 0, 29 * MM)[None])[0] == pytest.approx(1 * MM, abs=1e-8)
    # an orthographic camera is infinitely far away
    assert caster.penetration(ORTHOGRAPHIC, at(0, 0, 0)[None])[0] == pytest.approx(30 * MM, abs=1e-8)


def test_details_finer_than_the_rays_are_found_by_their_vertices():
    block = trimesh.creation.box((20 * MM, 20 * MM, 4 * MM))
    block.apply_translation([0, 0, 2.5 * MM])
    spike = trimesh.Trimesh(
        [[1.013 * MM, 2.027 * MM, -0.7 * MM], [1.02 * MM, 2.02 * MM, 1 * MM], [1.0 * MM, 2.02 * MM, 1 * MM]]
        + [[1.01 * MM, 2.04 * MM, 1 * MM]],
        [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]],
    )
    spike.fix_normals()
    both = trimesh.util.concatenate([block, spike])
    caster = Caster(both.vertices, both.faces)
    for sensor in (ORTHOGRAPHIC, PERSPECTIVE, WIDE_ANGLE):
        assert caster.penetration(sensor, np.eye(4)[None])[0] == pytest.approx(0.7 * MM, abs=1e-9)
    assert Caster(block.vertices, block.faces).penetration(PERSPECTIVE, np.eye(4)[None])[0] < 0


@each_sensor
def test_x_is_to_the_right_and_y_is_down(sensor):
    caster = box((2 * MM, 2 * MM, 8 * MM), (0, 0, 4 * MM))
    h, w = sensor.image_size_px[::-1]

    def centroid(x, y):
        rows, columns = np.nonzero(caster.contact(sensor, at(x, y, -1 * MM)).mask)
        return columns.mean() - (w - 1) / 2, rows.mean() - (h - 1) / 2

    assert np.abs(centroid(0, 0)).max() < 0.51
    right, level = centroid(4 * MM, 0)
    assert right > 50 and abs(level) < 2
    straight, down = centroid(0, 3 * MM)
    assert down > 40 and abs(straight) < 2


def test_a_turn_about_z_is_clockwise_on_the_image():
    """+x to the right and +y down make a positive turn about +z, which points away from the camera, clockwise."""
    caster = box((2 * MM, 2 * MM, 8 * MM), (4 * MM, 0, 4 * MM))
    quarter = transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, -1 * MM])
    rows, columns = np.nonzero(caster.contact(ORTHOGRAPHIC, quarter).mask)
    assert rows.mean() > 180 and abs(columns.mean() - 159.5) < 1


def hits_one_by_one(triangles, start, ray):
    """First hit (m,) of rays, by Moeller and Trumbore's test of every ray with every triangle (f, 3, 3)."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    best = np.full(len(ray), np.inf)
    for i in range(len(a)):
        p = np.cross(ray, e2[i])
        det = p @ e1[i]
        s = start - a[i]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (p * s).sum(1) / det
            q = np.cross(s, e1[i])
            v = (ray * q).sum(1) / det
            t = q @ e2[i] / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        best[hit] = np.minimum(best, t)[hit]
    return best


@each_sensor
def test_masks_and_heights_equal_rays_traced_in_the_sensor_frame(sensor, rng):
    """The library turns the rays into the object's frame; here the object is turned instead."""
    mesh = load_mesh("bracket")
    caster = Caster(mesh.vertices, mesh.faces)
    x, y = (c.ravel() for c in np.meshgrid(*sensor.pixel_centres((24, 32))))
    D = sensor.camera_distance
    start = np.stack([0 * x, 0 * x, 0 * x - D], 1) if D else np.stack([x, y, 0 * x - 1], 1)
    ray = np.stack([x, y, 0 * x], 1) - start if D else np.tile([0.0, 0, 1], (len(x), 1))
    touched = 0
    for R in random_rotations(4, rng):
        moved = mesh.vertices @ R.T
        lowest = moved[moved[:, 2].argmin()]
        T = transform(R, [-lowest[0] + 2 * MM, -lowest[1], -lowest[2] - 1.5 * MM])
        triangles = apply(T, mesh.vertices)[mesh.faces]
        triangles = triangles[triangles[..., 2].min(1) < 5 * MM]
        t = hits_one_by_one(triangles, start, ray)
        p = start + np.where(np.isfinite(t), t, 0)[:, None] * ray
        M = sensor.membrane_radius
        sag = M - np.sqrt(M**2 - np.minimum(p[:, 0] ** 2 + p[:, 1] ** 2, M**2)) if M else 0
        depth = np.where(np.isfinite(t), -p[:, 2] - sag, -np.inf)
        got = caster.depths(sensor, T[None], (24, 32))[0].ravel()
        clear = np.abs(depth) > 1e-6
        assert ((got > 0) == (depth > 0))[clear].mean() > 0.998
        contact = (depth > 1e-6) & (got > 0)
        touched += contact.sum()
        assert not contact.any() or np.median(np.abs(got - depth)[contact]) < 1e-7
    assert touched > 100


@each_sensor
def test_poses_and_rays_cast_together_or_alone_are_the_same(sensor, rng):
    mesh = load_mesh("hex_nut")
    T = transform(random_rotations(300, rng), np.array([0, 0, 5 * MM]))
    caster = Caster(mesh.vertices, mesh.faces, threads=2)
    together = caster.depths(sensor, T, (24, 32))
    alone = Caster(mesh.vertices, mesh.faces, threads=1)
    for i in (0, 150, 299):
        assert (alone.depths(sensor, T[i : i + 1], (24, 32))[0] == together[i]).all()
    some = caster.penetration(sensor, T)
    assert (some >= together.max((1, 2)) - 2e-5).all()


def test_the_housing_is_entered_by_what_reaches_below_it_outside_the_window():
    caster = box((40 * MM, 4 * MM, 4 * MM), (0, 0, 2 * MM))
    assert caster.lowest_outside(PERSPECTIVE, at(0, 0, -1 * MM)[None])[0] == pytest.approx(-1 * MM)
    assert caster.lowest_outside(PERSPECTIVE, at(0, 0, 1 * MM)[None])[0] == np.inf
    small = box((4 * MM, 4 * MM, 4 * MM), (0, 0, 2 * MM))
    assert small.lowest_outside(PERSPECTIVE, at(0, 0, -1 * MM)[None])[0] == np.inf
