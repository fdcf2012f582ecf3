"""Laws of rigid transforms: exponential and logarithm undo one another, and what is no transform is refused."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from geomtact.errors import PoseError
from geomtact.se3 import (
    adjoint,
    apply,
    check_transforms,
    exp,
    hat,
    inverse,
    log,
    quat_xyzw,
    random_rotations,
    transform,
)


def twists(rng, angle, n=200):
    """Twists (n, 6) that turn by ``angle`` [rad] and shift by about 10 cm."""
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return np.concatenate([angle * axis, rng.normal(size=(n, 3)) * 0.1], 1)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9e-6, 1.1e-5, 9e-5, 1.1e-4, 1e-2, 1.0, 3.0, np.pi - 1e-3])
def test_log_undoes_exp(rng, angle):
    xi = twists(rng, angle)
    assert np.abs(log(exp(xi)) - xi).max() < 1e-9


@pytest.mark.parametrize("below_pi", [0.0, 1e-12, 1e-9, 1e-6, 1e-4])
def test_exp_undoes_log_up_to_half_a_turn(rng, below_pi):
    """At half a turn the axis may come back reversed, so the transform is what must return."""
    T = exp(twists(rng, np.pi - below_pi))
    xi = log(T)
    assert np.linalg.norm(xi[:, :3], axis=1).max() <= np.pi + 1e-9
    assert np.abs(exp(xi) - T).max() < 1e-7


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.7, 3.1])
def test_exp_is_the_matrix_exponential(rng, angle):
    for xi in twists(rng, angle, 10):
        A = np.zeros((4, 4))
        A[:3, :3], A[:3, 3] = hat(xi[:3]), xi[3:]
        assert np.abs(exp(xi) - expm(A)).max() < 1e-12


def test_exp_and_log_keep_the_shape(rng):
    xi = rng.normal(size=(2, 3, 6))
    assert exp(xi).shape == (2, 3, 4, 4) and log(exp(xi)).shape == (2, 3, 6)
    assert exp(xi[0, 0]).shape == (4, 4)
    assert np.abs(exp(xi)[1, 2] - exp(xi[1, 2])).max() < 1e-15


def test_hat_is_the_cross_product(rng):
    a, b = rng.normal(size=(2, 5, 3))
    assert np.abs((hat(a) @ b[..., None])[..., 0] - np.cross(a, b)).max() < 1e-15


def test_transforms_compose_and_invert(rng):
    T, S = exp(rng.normal(size=(2, 20, 6)))
    points = rng.normal(size=(7, 3))
    assert apply(T, points).shape == (20, 7, 3)
    each = np.stack([apply(b, apply(a, points)) for a, b in zip(S, T, strict=True)])
    assert np.abs(apply(T @ S, points) - each).max() < 1e-14
    assert np.abs(inverse(T) @ T - np.eye(4)).max() < 1e-14
    assert np.abs(inverse(T @ S) - inverse(S) @ inverse(T)).max() < 1e-14
    homogeneous = np.concatenate([points, np.ones((7, 1))], 1)
    assert np.abs(apply(T[0], points) - (homogeneous @ T[0].T)[:, :3]).max() < 1e-15


def test_the_adjoint_carries_twists_over_a_pose(rng):
    T, xi = exp(rng.normal(size=(5, 6))), 0.3 * rng.normal(size=(5, 6))
    carried = (adjoint(T) @ xi[..., None])[..., 0]
    assert np.abs(T @ exp(xi) - exp(carried) @ T).max() < 1e-12


def test_the_twist_acts_in_the_objects_own_frame(rng):
    """T exp(xi^) shifts along the object's axes, not the sensor's."""
    T = exp(rng.normal(size=6))
    moved = T @ exp([0, 0, 0, 0.01, 0, 0])
    assert np.abs(moved[:3, 3] - T[:3, 3] - 0.01 * T[:3, 0]).max() < 1e-15


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), r"expected rigid transforms of shape \(..., 4, 4\), got \(3, 3\)"),
        (np.zeros(4), r"got \(4,\)"),
        (np.full((4, 4), np.nan), "expected finite numbers, got NaN or infinity"),
        (np.diag([1.0, 1, 1, np.inf]), "NaN or infinity"),
        (np.diag([2.0, 1, 1, 1]), "the upper left 3x3 is no rotation"),
        (np.diag([-1.0, 1, 1, 1]), "the upper left 3x3 is no rotation"),
        (np.zeros((4, 4)), "is no rotation"),
        (transform(np.eye(3), [0, 0, 1]).T, "the last row must be 0 0 0 1"),
    ],
)
def test_what_is_no_transform_is_refused(T, message):
    with pytest.raises(PoseError, match=message):
        check_transforms(T)


def test_one_bad_transform_among_many_is_found_and_named(rng):
    T = exp(rng.normal(size=(50, 6)))
    assert check_transforms(T, "mine") is not None
    T[37, 0, 0] += 1e-5
    with pytest.raises(PoseError, match="^mine, matrix 38 of 50: "):
        check_transforms(T, "mine")


def test_lists_are_taken_and_nothing_is_changed():
    assert check_transforms(np.eye(4).tolist()).dtype == np.float64
    assert check_transforms(np.zeros((0, 4, 4))).shape == (0, 4, 4)


def test_random_rotations_are_uniform(rng):
    """Under the Haar measure each column is uniform on the sphere, and the angle has density (1 - cos) / pi."""
    R = random_rotations(4000, rng)
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-12
    assert np.linalg.det(R) == pytest.approx(np.ones(4000))
    for i, j in np.ndindex(3, 3):
        assert kstest(R[:, i, j], "uniform", args=(-1, 2)).pvalue > 1e-4
    angle = Rotation.from_matrix(R).magnitude()
    assert kstest(angle, lambda t: (t - np.sin(t)) / np.pi).pvalue > 1e-4


def test_quaternions_are_x_y_z_w(rng):
    half = np.pi / 4
    T = exp([0, 0, 2 * half, 0, 0, 0])
    assert quat_xyzw(T) == pytest.approx([0, 0, np.sin(half), np.cos(half)])
    for R in random_rotations(50, rng):
        x, y, z, w = q = quat_xyzw(transform(R, np.zeros(3)))
        assert w >= 0 and np.linalg.norm(q) == pytest.approx(1)
        again = np.eye(3) + 2 * w * hat([x, y, z]) + 2 * hat([x, y, z]) @ hat([x, y, z])
        assert np.abs(again - R).max() < 1e-12
