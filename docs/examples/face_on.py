"""A part pressed flat onto the gel, with and without saying so: where the truth lies in the answer.

    python docs/examples/face_on.py [--face X Y Z] [--max-poses N] [--touches N] [--tilt DEGREES ...]

Half a step of a coarse grid lifts a large face off the gel, so directions are finer about plane faces. With approach, only
touches near to that face are modelled. Some four minutes on two cores, the first time.
"""

import argparse

import numpy as np
import trimesh

from geomtact import Localizer, Mesh, Sensor, load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.se3 import exp
from geomtact.sensing.noise import MODERATE

MM = 1e-3
SENSOR = Sensor.load("gelsight-mini")
FACE = (0.0, 0.0, -1.0)  # the largest: towards the sensor, in the part's frame
LEAST = 200  # pixels of contact that are worth a look


def make_part():
    """An L of 40 x 30 x 8 mm with a hole and a boss; metres."""
    plate, corner = trimesh.creation.box((40, 30, 8)), trimesh.creation.box((30, 20, 10))
    hole, boss = trimesh.creation.cylinder(2.5, 20), trimesh.creation.cylinder(3.5, 6)
    for solid, place in ((corner, (8, 8, 0)), (hole, (-14, -4, 0)), (boss, (10, -11, 6))):
        solid.apply_translation(place)
    part = trimesh.boolean.union([trimesh.boolean.difference([plate, corner, hole]), boss])
    return load_mesh(Mesh(MM * part.vertices, part.faces, "corner", "m"), sensor=SENSOR)


def touches(mesh, face, tilt, n, rng):
    """Poses (4, 4) at which ``face`` (3,) lies on the gel but for ``tilt`` degrees any way, and what is felt there."""
    space = ContactSpace(mesh, SENSOR)
    flat, _ = ContactSpace(mesh, SENSOR, [(face, 0.0)]).sample(4 * n, rng)
    found = []
    for i, T in enumerate(flat):
        if len(found) == n:
            break
        way = np.cross(face, rng.normal(size=3))
        T = T @ exp(np.append(np.deg2rad(tilt) * way / np.linalg.norm(way), np.zeros(3)))
        T[2, 3] += space.caster.penetration(SENSOR, T[None])[0] - 0.8 * MM
        if not np.isfinite(space.penetration(T[None])[0]):  # the housing is in the way
            continue
        mask = simulate_mask(space, T, elastic=i % 2 == 0)
        if mask.sum() >= LEAST:
            found.append((T, spoilt(mask, space, MODERATE, rng)))
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--face", type=float, nargs=3, default=FACE)
    parser.add_argument("--max-poses", type=int, default=300_000)
    parser.add_argument("--touches", type=int, default=24)
    parser.add_argument("--tilt", type=float, nargs="*", default=[0.0, 1.0, 3.0])
    asked = parser.parse_args()
    mesh = make_part()
    known = {"any side": None, "that side, within 3 degrees": [(asked.face, np.deg2rad(3))]}
    localizers = {
        name: Localizer.prepare(mesh, sensor=SENSOR, approach=side, max_poses=asked.max_poses)
        for name, side in known.items()
    }
    for tilt in asked.tilt:
        felt = touches(mesh, asked.face, tilt, asked.touches, np.random.default_rng(1))
        for name, localizer in localizers.items():
            told = [(localizer.localize(mask), T) for T, mask in felt]
            level = np.array([posterior.credible_level(T) for posterior, T in told])
            gain = np.mean([posterior.log_density(T) for posterior, T in told])
            claimed = -np.mean([posterior.entropy_nats for posterior, _ in told])
            outside = [f"{100 * np.mean(level > mass):.0f} %" for mass in (0.9, 0.99)]
            print(
                f"{tilt:g} degrees off, {name}: of {len(felt)} truths {outside[0]} outside the 90 % region, {outside[1]} outside "
                f"the 99 % region; {gain:.1f} nats told, {claimed:.1f} claimed"
            )


if __name__ == "__main__":
    main()
