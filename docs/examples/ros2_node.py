"""A ROS 2 node around geomtact: images of one sensor in, poses with covariance out.

It needs rclpy and cv_bridge, which geomtact does not. Parameters: object and sensor, names or files.
"""

import rclpy
from cv_bridge import CvBridge
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import Image

from geomtact import GeomtactError, Localizer
from geomtact.report.exchange import to_ros


class Touch(Node):
    """Localizes the newest image; what is not sure is published too, and says so by its probability in the log."""

    def __init__(self):
        super().__init__("geomtact")
        part = self.declare_parameter("object", "pin").value
        sensor = self.declare_parameter("sensor", "gelslim").value
        self.localizer = Localizer.prepare(part, sensor=sensor)
        self.background = None
        self.bridge = CvBridge()
        self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 1)
        self.create_subscription(Image, "image", self.seen, 1)  # depth 1: no queue of old images

    def seen(self, message):
        image = self.bridge.imgmsg_to_cv2(message, "rgb8")
        if self.background is None:
            self.background = image  # the first image has to be of the untouched sensor
            return
        try:
            posterior = self.localizer.localize(image, kind="reading", background=self.background)
        except GeomtactError as error:
            self.get_logger().warning(str(error))
            return
        for mode in posterior.modes(1):
            told = to_ros(mode, message.header.frame_id)
            out = PoseWithCovarianceStamped(header=message.header)
            for name, value in told["pose"]["pose"]["position"].items():
                setattr(out.pose.pose.position, name, value)
            for name, value in told["pose"]["pose"]["orientation"].items():
                setattr(out.pose.pose.orientation, name, value)
            out.pose.covariance = told["pose"]["covariance"]
            self.poses.publish(out)
            self.get_logger().info(f"the first mode holds {100 * mode.probability:.0f} %")


rclpy.init()
rclpy.spin(Touch())
