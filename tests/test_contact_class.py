"""Laws of the contact classes: solids whose contacts follow from their construction."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from geomtact.contact_space.contact_class import CLASSES, contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.geometry.mesh import Mesh
from geomtact.se3 import transform
from geomtact.sensing.sensor import Sensor

MM = 1e-3
SENSOR = Sensor("plain", (320, 240), (0.1 * MM, 0.1 * MM), 0.0, 2 * MM)


def pressed(solid, R, depth=1 * MM):
    """The space of a solid, and it turned by ``R`` and pressed in over the window's middle."""
    mesh = Mesh(np.asarray(solid.vertices), np.asarray(solid.faces), "solid", "m")
    space = ContactSpace(mesh, SENSOR)
    T = transform(R, np.zeros(3))
    lowest = (mesh.vertices @ R.T)[:, 2].min()
    point = (mesh.vertices @ R.T)[np.isclose((mesh.vertices @ R.T)[:, 2], lowest, atol=1e-6)].mean(0)
    T[:3, 3] = [-point[0], -point[1], -lowest - depth]
    return space, T


def turned(axis, degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()


def comb():
    teeth = [trimesh.creation.box((2 * MM, 8 * MM, 6 * MM)).apply_translation((4 * MM * i, 0, 0)) for i in range(-2, 3)]
    back = trimesh.creation.box((24 * MM, 8 * MM, 4 * MM)).apply_translation((0, 0, 4 * MM))
    return trimesh.boolean.union([*teeth, back], engine="manifold")


BOX = trimesh.creation.box((12 * MM, 12 * MM, 12 * MM))
CYLINDER = trimesh.creation.cylinder(8 * MM, 30 * MM, sections=96)


@pytest.mark.parametrize(
    ("solid", "R", "expected"),
    [
        (BOX, np.eye(3), "flat"),
        (BOX, turned([1, 0, 0], 45), "edge"),
        (BOX, turned([1, -1, 0], 54.7356), "corner"),
        (CYLINDER, turned([1, 0, 0], 90), "cylinder"),
        (CYLINDER, np.eye(3), "flat"),
        (trimesh.creation.icosphere(4, 12 * MM), np.eye(3), "cylinder"),
        (comb(), np.eye(3), "texture"),
    ],
    ids=["face", "edge", "corner", "lying cylinder", "standing cylinder", "ball", "comb"],
)
def test_a_contact_is_of_the_class_it_was_made_for(solid, R, expected):
    assert expected in CLASSES
    space, T = pressed(solid, R)
    assert contact_class(space, T) == expected
    # turned about the sensor's axis and a little elsewhere, it is the same contact
    motion = transform(turned([0, 0, 1], 33), [1 * MM, -0.5 * MM, 0])
    assert contact_class(space, motion @ T) == expected
