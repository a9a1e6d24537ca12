"""Reconstructs a recorded bag with `storm replay` from a launch file.

    ros2 launch storm replay.launch.py bag:=/path/to/bag out:=/path/to/results
"""
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackagePrefix, FindPackageShare


def generate_launch_description():
    program = PathJoinSubstitution([FindPackagePrefix("storm"), "lib", "storm", "storm"])
    default_config = PathJoinSubstitution([FindPackageShare("storm"), "config", "storm.yaml"])
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="MCAP or sqlite3 bag, file or folder"),
        DeclareLaunchArgument("out", default_value="storm_out", description="results folder"),
        DeclareLaunchArgument("config", default_value=default_config, description="configuration file"),
        ExecuteProcess(
            cmd=[program, "replay", LaunchConfiguration("bag"), "--out", LaunchConfiguration("out"),
                 "--config", LaunchConfiguration("config")],
            output="screen",
        ),
    ])
