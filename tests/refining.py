"""Touches at a given pose, for laws of refinement."""

import numpy as np
import trimesh

from geomtact import se3
from geomtact.registration.protocol import Refinement
from geomtact.registration.surface import Surface
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor

SENSOR = Sensor("test", (64, 48), (0.3e-3, 0.3e-3), 20e-3, 2e-3)
SHIFT, TURN = 0.8e-3, np.deg2rad(3)


def stepped_block():
    """Two boxes of different width, the narrow one on top: no two corners are alike."""
    low = trimesh.creation.box((30e-3, 22e-3, 6e-3))
    high = trimesh.creation.box((12e-3, 8e-3, 6e-3))
    high.apply_translation((-4e-3, 2e-3, 6e-3))
    return trimesh.util.concatenate([low, high])


def scene(mesh, n=40000, seed=0):
    points, face = trimesh.sample.sample_surface(mesh, n, seed=seed)
    return Surface(np.asarray(points), np.asarray(mesh.face_normals[face])), Caster(mesh.vertices, mesh.faces)


def touch(caster, T):
    return caster.contact(SENSOR, T).mask


def off(T, problem, rng, shift=SHIFT, turn=TURN):
    """``T`` turned about the contact's centre and shifted, each by a fixed amount in a random direction."""
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    about = se3.transform(np.eye(3), problem.centre)
    return about @ se3.exp([*(turn * axis), *(shift * way)]) @ se3.inverse(about) @ T


def told_error(result, T_true, T, i=0):
    """Size of the error of ``T`` along the directions that ``result`` calls observable [m]."""
    xi = se3.log(se3.inverse(T_true) @ T)
    return np.linalg.norm(result.observable[i] @ (np.repeat([result.length, 1.0], 3) * xi))


def facing_down(x, y, depth, height, tilt=(0.0, 0.0), turn=0.0):
    """Pose of an object whose top, at z = height in its own frame, is pressed ``depth`` below the membrane."""
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    return (
        se3.transform(np.eye(3), [x, y, -depth])
        @ se3.exp([*tilt, turn, 0, 0, 0])
        @ half_turn
        @ se3.transform(np.eye(3), [0, 0, -height])
    )


def is_sound(result: Refinement, k: int):
    """What must hold of every result: shapes, no NaN, rigid poses, valid covariances, orthonormal rows."""
    assert result.T.shape == (k, 4, 4) and result.covariance.shape == (k, 6, 6) and len(result.observable) == k
    assert result.converged.shape == result.residual.shape == result.support.shape == (k,)
    assert np.isfinite(result.covariance).all() and not np.isnan(result.residual).any()
    se3.check_transforms(result.T)
    for covariance, rows in zip(result.covariance, result.observable, strict=True):
        scale = np.repeat([result.length, 1.0], 3)
        assert np.linalg.eigvalsh(covariance * np.outer(scale, scale)).min() > 0
        assert rows.shape[1] == 6 and np.allclose(rows @ rows.T, np.eye(len(rows)), atol=1e-9)
