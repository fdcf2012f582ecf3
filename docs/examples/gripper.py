"""From two fingers to the part's pose in a robot program: sensors on a jaw whose width the robot reads.

The grasp is simulated; what follows it is what runs on a robot.
"""

import argparse
import json

import numpy as np

from geomtact import Localizer, se3
from geomtact.planning.jaw import close_jaw, first_grasp
from geomtact.report.exchange import to_ros

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--part", default="head", help="name of a bundled object, or a mesh file")
parser.add_argument("--unit", help="of a mesh file that states none: mm, cm, m or inch")
parser.add_argument("--sensor", default="gelslim")
parser.add_argument("--max-poses", type=int, default=300_000)
parser.add_argument("--seed", type=int, default=4)
options = parser.parse_args()

# The gripper's frame: its fingers open along y, and point along z. Each sensor looks at the other; its x is the gripper's x.
LEFT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # columns: the sensor's x, y and z in the gripper's frame
RIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FINGERTIP = 0.12  # m along z, from the gripper's origin to the middle of the windows


def T_gripper_sensor(width):
    """Poses (2, 4, 4) of both sensors with the membranes `width` [m] apart."""
    return np.stack(
        [
            se3.transform(LEFT, [0, 0.5 * width, FINGERTIP]),
            se3.transform(RIGHT, [0, -0.5 * width, FINGERTIP]),
        ]
    )


def grasped(localizer, rng):
    """A simulated grasp: how wide the jaw stops, both masks, and the part's true pose in the gripper's frame."""
    middle = se3.transform(LEFT, [0, 0, FINGERTIP])  # a jaw that closes along the gripper's y
    while True:
        T_gripper_part = middle @ se3.inverse(first_grasp(localizer.mesh, rng))
        stops, touches = close_jaw(localizer.space, T_gripper_part, middle, [1e-3, 1e-3])
        if touches.all():
            break
    # both fingers move alike, so the part comes to lie in the middle
    T_gripper_part[1, 3] -= 0.5 * (stops[0, 1, 3] + stops[1, 1, 3])
    width = stops[0, 1, 3] - stops[1, 1, 3]
    masks = [localizer.simulate(se3.inverse(T) @ T_gripper_part).mask for T in T_gripper_sensor(width)]
    return width, masks, T_gripper_part


localizer = Localizer.prepare(options.part, options.unit, options.sensor, max_poses=options.max_poses)
width, masks, truth = grasped(localizer, np.random.default_rng(options.seed))

# --- from here on as on the robot: `width` comes from its joint, `masks` from its cameras
posterior = localizer.localize(masks, T_world_sensor=T_gripper_sensor(width))
first = posterior.modes(1)[0]
T_base_gripper = se3.transform(np.diag([1.0, -1, -1]), [0.4, 0.1, 0.3])  # from the robot's forward kinematics
T_base_object = T_base_gripper @ first.T
print(f"the jaw is {1e3 * width:.1f} mm open; the first mode holds {100 * first.probability:.0f} %")
print(f"the part's origin is at {np.round(1e3 * T_base_object[:3, 3], 1)} mm in the base frame")
if first.probability >= 0.95:
    print("sure enough to place it")
else:
    touch = localizer.next_touch(posterior)[0]
    where = np.round(1e3 * (T_base_gripper @ touch.T_world_sensor)[:3, 3], 1)
    print(f"not sure: touch from {where} mm next, expected gain {touch.expected_nats:.1f} nats")
print(json.dumps(to_ros(first, "gripper"))[:120], "...")
print(f"(information gain at the true pose: {posterior.log_density(truth):.1f} nats)")
