"""Starts the node with a file of parameters: `ros2 launch spikeserve_ros spikeserve.launch.py params:=my.yaml`."""

import pathlib

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

CONFIGURATION = pathlib.Path(__file__).parents[1] / "config" / "cartpole.yaml"


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=str(CONFIGURATION), description="File of parameters"),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the robot"),
            Node(
                package="spikeserve_ros",
                executable="node",
                name="spikeserve",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params")],
                respawn=True,
                respawn_delay=1.0,
                output="screen",
            ),
        ]
    )
