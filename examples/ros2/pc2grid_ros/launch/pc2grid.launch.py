"""ros2 launch pc2grid_ros pc2grid.launch.py database:=/maps/building.submaps"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition


def generate_launch_description() -> LaunchDescription:
    """Return the node, configured and activated; its parameters are in config/pc2grid.yaml."""
    settings = Path(get_package_share_directory("pc2grid_ros")) / "config" / "pc2grid.yaml"
    node = LifecycleNode(
        package="pc2grid_ros",
        executable="pc2grid",
        name="pc2grid",
        namespace="",
        output="screen",
        parameters=[LaunchConfiguration("params_file"), {"database": LaunchConfiguration("database")}],
    )

    def change(transition: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=transition)
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("database", description="the database of the building"),
            DeclareLaunchArgument("params_file", default_value=str(settings)),
            node,
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=node,
                    start_state="configuring",
                    goal_state="inactive",
                    entities=[change(Transition.TRANSITION_ACTIVATE)],
                )
            ),
            change(Transition.TRANSITION_CONFIGURE),
        ]
    )
