"""ros2 launch og_pointcloud_ros map.launch.py map:=/maps/room.ogpc depth:=/camera/depth/image_rect masks:=/masks ..."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory  # pyright: ignore[reportMissingImports]
from launch import LaunchDescription  # pyright: ignore[reportMissingImports]
from launch.actions import DeclareLaunchArgument  # pyright: ignore[reportMissingImports]
from launch.substitutions import LaunchConfiguration  # pyright: ignore[reportMissingImports]
from launch_ros.actions import Node  # pyright: ignore[reportMissingImports]

TOPICS = {
    "depth": "/depth/image_rect", "masks": "/masks", "features": "/mask_features", "color": "/color/image_rect",
    "info": "/camera_info",
}  # fmt: skip


def generate_launch_description() -> LaunchDescription:
    """One node, its parameters from a file, the map's file and the topics from the command line."""
    defaults = Path(get_package_share_directory("og_pointcloud_ros")) / "config" / "map.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", default_value="", description="the .ogpc file to save to and load from"),
            DeclareLaunchArgument(
                "parameters", default_value=str(defaults), description="the other parameters (.yaml)"
            ),
            *(DeclareLaunchArgument(role, default_value=topic) for role, topic in TOPICS.items()),
            Node(
                package="og_pointcloud_ros",
                executable="map",
                name="og_pointcloud_map",
                output="screen",
                parameters=[LaunchConfiguration("parameters"), {"map": LaunchConfiguration("map")}],
                remappings=[(f"~/input/{role}", LaunchConfiguration(role)) for role in TOPICS],
            ),
        ]
    )
