"""Nav2 with coview_stream in place of AMCL: ``ros2 launch nav2.launch.py site:=site.coview params:=nav2.yaml``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the map server, coview_stream and Nav2."""
    site, params = LaunchConfiguration("site"), LaunchConfiguration("params")
    navigation = PathJoinSubstitution([FindPackageShare("nav2_bringup"), "launch", "navigation_launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("site", description="map from coview-stream build"),
            DeclareLaunchArgument("params", default_value="nav2.yaml"),
            # no package: a command in PATH; launch adds --ros-args with name, parameters and remappings
            Node(
                executable="coview-stream",
                name="coview_stream",
                arguments=["serve", site, "--robot", "robot", "--ros2"],
                parameters=[params],
                remappings=[("/robot/points", "/points"), ("/robot/odom", "/odom")],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
            # the grid that the planner needs: AMCL alone is replaced
            Node(package="nav2_map_server", executable="map_server", name="map_server", parameters=[params]),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                name="lifecycle_manager_map",
                parameters=[{"autostart": True, "node_names": ["map_server"]}],
            ),
            # without localization_launch.py, which would start AMCL
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(navigation), launch_arguments={"params_file": params}.items()
            ),
        ]
    )
