"""The thesis's pencil (figures 16 and 17): grasped by its middle it may lie either way round; which touch decides?

A parallel jaw with a sensor in each finger holds a pencil on two of its flats. Both contacts are featureless, so the pose stays
unknown along the pencil, and the pencil may be turned round. The planner is asked to choose between touches along the pencil and
at its ends. Writes out/pencil/next_touch.png; some seconds, after a minute to simulate the grid.
"""

from pathlib import Path

import numpy as np
import trimesh

from geomtact import Localizer, Touch, load_mesh
from geomtact.planning.actions import Probe
from geomtact.planning.next_touch import ambiguity, next_touch
from geomtact.report.next_touch_plot import draw_next_touch
from geomtact.se3 import inverse, transform

MM = 1e-3
OUT = Path("out/pencil")


def make_pencil(path):
    """A hexagonal body from x = -50 to 30 mm, 8 mm across its flats, and a tip that ends at 50 mm."""
    turn = np.arange(6) * np.pi / 3
    hexagon = 8 / np.sqrt(3) * np.stack([np.cos(turn), np.sin(turn)], 1)
    ends = [np.column_stack([np.full(6, x), hexagon]) for x in (-50.0, 30.0)]
    trimesh.convex.convex_hull(np.concatenate([*ends, [[50.0, 0, 0]]])).export(path)
    return path


OUT.mkdir(parents=True, exist_ok=True)
part = load_mesh(make_pencil(OUT / "pencil.stl"), "mm")
flats = np.unique(part.normals[np.abs(part.normals[:, 0]) < 1e-6].round(6), axis=0)
localizer = Localizer.prepare(part, sensor="gelslim", approach=[(flat, 0.0) for flat in flats], max_poses=50_000)

# the fingers look at each other along z; the pencil lies along x, one of its flats down
up = flats[np.argmax(flats[:, 2])]
truth = transform(np.stack([[1.0, 0, 0], np.cross(up, [1.0, 0, 0]), up]), np.zeros(3))
below, above = (transform(np.diag([1.0, s, s]), [0, 0, -s * 4 * MM + s * 1 * MM]) for s in (1.0, -1.0))
fingers = np.stack([below, above])
images = [localizer.simulate(inverse(finger) @ truth).mask for finger in fingers]
posterior = localizer.localize(images, T_world_sensor=fingers)
modes = posterior.modes(2)
print(
    f"{posterior.information_gain_nats:.1f} nats gained; first modes {', '.join(f'{100 * m.probability:.0f} %' for m in modes)}"
)


def side(x):
    """A touch from the side, at ``x`` [m] along the pencil."""
    return Touch(transform(np.stack([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], 1), [x, -0.1, 0]), travel=0.2)


def end(sign):
    """A touch along the pencil's own axis, from its left or right."""
    z = np.array([-sign, 0.0, 0.0])
    return Touch(transform(np.stack([[0, 1.0, 0], np.cross(z, [0, 1.0, 0]), z], 1), [sign * 0.15, 0, 0]), travel=0.3)


names = [
    "side, middle",
    "side, left",
    "side, right",
    "right end",
    "left end",
    "finger at the right end",
    "finger in the middle",
]
actions = [
    side(0),
    side(-0.02),
    side(0.02),
    end(1),
    end(-1),
    Probe([0.05, 0, 0], [0, 1, 0]),
    Probe([0, 0, 0], [0, 1, 0]),
]
ranked = next_touch(posterior, actions)
for action in ranked:
    print(
        f"{names[action.number - 1]:24s} {action.expected_nats:.2f} nats, discards {100 * action.expected_discarded:.0f} %"
    )
print(ambiguity(ranked) or f"touch next: {names[ranked[0].number - 1]}")
(OUT / "next_touch.png").write_bytes(draw_next_touch(posterior, ranked))
