# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Feed the node from a front-end: one camera passes 400 points, and the poses of its odometry come back refined.

Start the node in one terminal (.venv/bin/ba_node, or ros2 launch ba_node ba_node.launch.py) and this in another
(.venv/bin/python examples/front_end.py, or python3 where ROS is sourced).
"""

import sys
import time

import numpy as np
import rclpy
from ba_msgs.msg import FeatureTracks, Keyframe, RefinedKeyframes
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo


class FrontEnd(Node):
    def __init__(self, fx, fy, cx, cy, **options):
        super().__init__("my_front_end", **options)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.cameras = self.create_publisher(CameraInfo, "camera_info", latched)
        self.keyframes = self.create_publisher(Keyframe, "keyframes", 100)
        self.tracks = self.create_publisher(FeatureTracks, "feature_tracks", 100)
        self.create_subscription(RefinedKeyframes, "ba_node/refined_keyframes", self.on_refined, 100)
        camera = CameraInfo(distortion_model="plumb_bob", d=[0.0] * 5)
        camera.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        self.cameras.publish(camera)
        self.refined = {}

    def send(self, number, stamp, position, orientation, ids, u, v):
        keyframe = Keyframe(session_id=1, keyframe_id=number)
        keyframe.header.stamp, keyframe.header.frame_id = stamp, "odom"  # your fixed frame
        pose = keyframe.pose.pose  # body in the fixed frame
        pose.position.x, pose.position.y, pose.position.z = position
        pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = orientation
        self.keyframes.publish(keyframe)
        tracks = FeatureTracks(session_id=1, keyframe_id=number)
        tracks.header.stamp, tracks.header.frame_id = stamp, "camera"
        tracks.track_id = ids  # the same id in every image that shows the same point
        tracks.u, tracks.v = u, v  # raw pixels
        self.tracks.publish(tracks)

    def on_refined(self, message):
        for number, position in zip(message.keyframe_id, np.reshape(message.position, (-1, 3)), strict=True):
            self.refined[number] = position


KEYFRAMES, FOCAL_PX, WIDTH, HEIGHT = 20, 400.0, 640, 480


def main():
    rng = np.random.default_rng(1)
    points = rng.uniform([-6.0, -3.0, 4.0], [12.0, 3.0, 10.0], (400, 3))
    truth = np.linspace([0.0, 0.0, 0.0], [6.0, 0.0, 1.0], KEYFRAMES)  # looking along z, and moving sideways
    odometry = truth + np.cumsum(rng.normal(0.0, 0.02, truth.shape), axis=0)

    rclpy.init()
    node = FrontEnd(FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2)
    # What is sent before the node is there is lost.
    wait_for(node, lambda: node.keyframes.get_subscription_count() and node.tracks.get_subscription_count())
    for number in range(KEYFRAMES):
        local = points - truth[number]
        uv = FOCAL_PX * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2] + rng.normal(0.0, 0.3, (len(points), 2))
        seen = np.flatnonzero(((uv > 0.0) & (uv < [WIDTH, HEIGHT])).all(axis=1))
        stamp = node.get_clock().now().to_msg()
        node.send(number, stamp, odometry[number].tolist(), (0.0, 0.0, 0.0, 1.0), seen.tolist(), *uv[seen].T.tolist())
        rclpy.spin_once(node, timeout_sec=0.1)
    all_came = wait_for(node, lambda: len(node.refined) == KEYFRAMES)
    refined = np.array([node.refined.get(number, odometry[number]) for number in range(KEYFRAMES)])
    for name, path in (("odometry", odometry), ("refined", refined)):
        print(f"{name}: {np.linalg.norm(path - truth, axis=1).mean():.3f} m from the truth")
    print(f"{len(node.refined)} of {KEYFRAMES} keyframes came back")
    node.destroy_node()
    rclpy.shutdown()
    return 0 if all_came else 1


def wait_for(node, condition, timeout_s=20.0):
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    return condition()


if __name__ == "__main__":
    sys.exit(main())
