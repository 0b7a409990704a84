"""ros2 launch og_pointcloud_ros segment.launch.py scene:=/maps/room.ogpc points:=/lidar/points."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory  # pyright: ignore[reportMissingImports]
from launch import LaunchDescription  # pyright: ignore[reportMissingImports]
from launch.actions import DeclareLaunchArgument  # pyright: ignore[reportMissingImports]
from launch.substitutions import LaunchConfiguration  # pyright: ignore[reportMissingImports]
from launch_ros.actions import Node  # pyright: ignore[reportMissingImports]


def generate_launch_description() -> LaunchDescription:
    """One node, its parameters from a file, the scene and the cloud's topic from the command line."""
    defaults = Path(get_package_share_directory("og_pointcloud_ros")) / "config" / "parameters.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="the .ogpc file to ask"),
            DeclareLaunchArgument("points", default_value="/points", description="topic of the clouds to label"),
            DeclareLaunchArgument(
                "parameters", default_value=str(defaults), description="the other parameters (.yaml)"
            ),
            Node(
                package="og_pointcloud_ros",
                executable="segment",
                name="og_pointcloud",
                output="screen",
                parameters=[LaunchConfiguration("parameters"), {"scene": LaunchConfiguration("scene")}],
                remappings=[("~/input/points", LaunchConfiguration("points"))],
            ),
        ]
    )
