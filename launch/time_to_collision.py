#!/usr/bin/env python3
"""An example for planners: time to collision from storm's flow (per pixel) and objects (per road user).

    ros2 run storm time_to_collision.py      (or: python3 launch/time_to_collision.py)
"""
import math

import numpy as np
import rclpy
from nav_msgs.msg import Path
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

ego, anchor = np.zeros(4), np.zeros(3)  # x y (m), vx vy (m/s) of the vehicle; x y yaw of storm_anchor: map frame


def trajectory(path):
    (a, b) = (path.poses[max(len(path.poses) - 11, 0)], path.poses[-1])
    seconds = b.header.stamp.sec - a.header.stamp.sec + 1e-9 * (b.header.stamp.nanosec - a.header.stamp.nanosec)
    at, before = (np.array([p.pose.position.x, p.pose.position.y]) for p in (b, a))
    ego[:] = [*at, *((at - before) / max(seconds, 1e-3))]


def transform(message):
    for t in (t.transform for t in message.transforms if t.child_frame_id == "storm_anchor"):
        anchor[:] = [t.translation.x, t.translation.y, 2 * math.atan2(t.rotation.z, t.rotation.w)]


def flow(cloud):  # points and the scene's own velocities (a wall has none) in frame storm_anchor, x forward
    p = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)
    turn = np.array([[math.cos(anchor[2]), math.sin(anchor[2])], [-math.sin(anchor[2]), math.cos(anchor[2])]])
    (x, y), closing = (p[:, :2] - turn @ (ego[:2] - anchor[:2])).T, (turn @ ego[2:])[0] - p[:, 3]
    ahead = (p[:, 6].view(np.uint32) & 1 > 0) & (x > 2) & (abs(y) < 1.2) & (p[:, 2] > -1) & (closing > 0.5)
    if ahead.any():
        print(f"flow: {np.percentile(x[ahead] / closing[ahead], 5):.1f} s to what is straight ahead ({ahead.sum()} points)")


def objects(array):  # arrows of namespace `velocity` start at an object and are one second of its way long, map frame
    for marker in (m for m in array.markers if m.ns == "velocity"):
        a, b = (np.array([p.x, p.y]) for p in marker.points)
        place, relative = a - ego[:2], (b - a) - ego[2:]
        seconds = -place @ relative / max(relative @ relative, 1e-6)
        print(f"object {marker.id}: nearest in {seconds:.1f} s at {np.linalg.norm(place + seconds * relative):.1f} m")


rclpy.init()
node = rclpy.create_node("time_to_collision")
for kind, topic, take in [(Path, "/storm/output/trajectory", trajectory), (TFMessage, "/tf", transform),
                          (PointCloud2, "/storm/output/flow", flow), (MarkerArray, "/storm/output/objects", objects)]:
    node.create_subscription(kind, topic, take, 5)
rclpy.spin(node)
