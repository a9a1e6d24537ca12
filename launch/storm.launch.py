"""The live node, or a recorded bag through `storm replay`.

    ros2 launch storm storm.launch.py
    ros2 launch storm storm.launch.py cameras:=3 images:=/left/image_raw,/front/image_raw,/right/image_raw pose:=/odom
    ros2 launch storm storm.launch.py mode:=replay bag:=/path/to/bag out:=/path/to/results
    ros2 launch storm storm.launch.py rviz:=true

Topics that are not named are found by type. `images` and `infos` are lists with commas, one entry per camera, in the
network's order (left to right).
"""
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackagePrefix, FindPackageShare

ARGUMENTS = [
    ("mode", "online", "online: the live node; replay: a bag into a results folder"),
    ("config", "", "parameter file; empty: the one that is installed"),
    ("name", "storm", "the node's name: outputs are /<name>/output/..."),
    ("namespace", "", "the node's namespace"),
    ("cameras", "0", "cameras that must be there before the node starts; 0: those there are"),
    ("images", "", "image topics (Image or CompressedImage), with commas; empty: found by type"),
    ("infos", "", "CameraInfo topics, with commas; empty: the ones beside the image topics"),
    ("pose", "", "pose topic (Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or /tf); empty: found by type"),
    ("reliability", "sensor_data", "sensor_data or reliable"),
    ("map_dir", "", "folder the map is kept in; empty: in memory alone"),
    ("use_sim_time", "false", "whether time is what /clock says"),
    ("rviz", "false", "whether to start RViz with storm's view"),
    ("bag", "", "mode replay: MCAP or sqlite3 bag, file or folder"),
    ("out", "storm_out", "mode replay: results folder"),
]


def listed(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def start(context):
    arg = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    share = FindPackageShare("storm")
    config = arg["config"] or PathJoinSubstitution([share, "config", "storm.yaml"])
    if arg["mode"] == "replay":
        program = PathJoinSubstitution([FindPackagePrefix("storm"), "lib", "storm", "storm"])
        return [ExecuteProcess(cmd=[program, "replay", arg["bag"], "--out", arg["out"], "--config", config], output="screen")]
    if arg["mode"] != "online":
        raise ValueError(f"mode:={arg['mode']}: wants online or replay")
    parameters = {
        "use_sim_time": arg["use_sim_time"] == "true",
        "live.cameras": int(arg["cameras"]),
        "live.reliability": arg["reliability"],
        "live.map_dir": arg["map_dir"],
        "input.pose": arg["pose"],
    }
    for key, name in [("input.images", "images"), ("input.camera_infos", "infos")]:
        # An empty list has no type in ROS; it is the default anyway.
        if listed(arg[name]):
            parameters[key] = listed(arg[name])
    actions = [Node(package="storm", executable="storm", name=arg["name"], namespace=arg["namespace"], arguments=["node"],
                    parameters=[config, parameters], output="screen")]
    if arg["rviz"] == "true":
        actions.append(Node(package="rviz2", executable="rviz2",
                            arguments=["-d", PathJoinSubstitution([share, "config", "storm.rviz"])], output="screen"))
    return actions


def generate_launch_description():
    declared = [DeclareLaunchArgument(name, default_value=default, description=about) for name, default, about in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
