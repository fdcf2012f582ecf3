"""Touch until sure: localize, ask for the touch with the largest expected gain, make it, and so on, until one mode holds 90 %.

A plug lies on a table; where, and how it is turned, is unknown. A sensor comes down on it. The robot is simulated: `make`
is what it feels, and nothing else looks at the truth. About half a minute on two cores, most of it to simulate the grid.
"""

import numpy as np

from geomtact import Localizer
from geomtact.geometry.distance import PoseDistance
from geomtact.planning.actions import Touch
from geomtact.planning.grid import grid_of_touches
from geomtact.planning.next_touch import ambiguity, next_touch
from geomtact.se3 import exp, inverse, transform

SURE, MOST_TOUCHES = 0.9, 10
PRESSED = 1e-3  # m: how deep the robot lets the part press into the gel

localizer = Localizer.prepare("connector_plug", sensor="gelslim", approach=[((0, 1, 0), 0.0)], max_poses=50_000)
upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # its +y points up
truth = transform(upright, [0.01, -0.015, 0.0]) @ exp([0, 1.4, 0, 0, 0, 0])


def make(touch):
    """The simulated robot: where its sensor stopped (4, 4), and the image."""
    stopped = touch.reached(localizer.space, truth, PRESSED)[0]
    return stopped, localizer.simulate(inverse(stopped) @ truth).mask


touch = Touch(transform(np.diag([1.0, -1.0, -1.0]), [0, 0, 0.1]), travel=0.1)  # straight down
stops, images = [], []
for number in range(1, MOST_TOUCHES + 1):
    stopped, image = make(touch)
    stops.append(stopped)
    images.append(image)
    posterior = localizer.localize(images, T_world_sensor=stops)
    mode = posterior.modes(1)[0]
    off = 1e3 * PoseDistance(localizer.mesh).mean(truth, mode.T[None])[0]
    known = f"{posterior.information_gain_nats:.1f} nats gained, mode 1 holds {100 * mode.probability:.0f} %"
    print(f"{number}: {known} (it is {off:.1f} mm off the truth)")
    if mode.probability >= SURE:
        break
    touches = grid_of_touches(posterior, made=stops)
    if not touches:
        print("   every touch that makes sense has been made")
        break
    ranked = next_touch(posterior, touches)
    touch = ranked[0].of
    x, y = 1e3 * touch.T_world_sensor[:2, 3]
    expected = (
        f"{ranked[0].expected_nats:.1f} nats expected, {ranked[-1].expected_nats:.1f} of the worst of {len(ranked)}"
    )
    print(f"   next at x = {x:.0f}, y = {y:.0f} mm: {expected}")
    if ambiguity(ranked):
        print(f"   {ambiguity(ranked)}")
        break
