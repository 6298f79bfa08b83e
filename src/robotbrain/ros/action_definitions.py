"""Action definitions in ROS interface language, for ``from <package>.action import <Name>``.

Add a row to :data:`ACTION_DEFINITIONS` to teach the kit another action; its classes, its CDR and the five topics and
services that carry it follow from the text. Field lists follow the ROS 2 Kilted packages of the same names
(https://docs.ros.org/en/kilted/p/).
"""

from __future__ import annotations

ACTION_DEFINITIONS: dict[str, str] = {
    "example_interfaces/action/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence",
    "test_msgs/action/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence",
    "tf2_msgs/action/LookupTransform": (
        "string target_frame\nstring source_frame\nbuiltin_interfaces/Time source_time\n"
        "builtin_interfaces/Duration timeout\nbuiltin_interfaces/Time target_time\nstring fixed_frame\nbool advanced\n"
        "---\ngeometry_msgs/TransformStamped transform\ntf2_msgs/TF2Error error\n---"
    ),
    "nav2_msgs/action/NavigateToPose": (
        "geometry_msgs/PoseStamped pose\nstring behavior_tree\n---\n"
        "uint16 NONE=0\nuint16 UNKNOWN=9000\nuint16 FAILED_TO_LOAD_BEHAVIOR_TREE=9001\nuint16 TF_ERROR=9002\n"
        "uint16 TIMEOUT=9003\nuint16 error_code\nstring error_msg\n---\n"
        "geometry_msgs/PoseStamped current_pose\nbuiltin_interfaces/Duration navigation_time\n"
        "builtin_interfaces/Duration estimated_time_remaining\nint16 number_of_recoveries\nfloat32 distance_remaining"
    ),
    "nav2_msgs/action/ComputePathToPose": (
        "geometry_msgs/PoseStamped goal\ngeometry_msgs/PoseStamped start\nstring planner_id\nbool use_start\n---\n"
        "uint16 NONE=0\nuint16 UNKNOWN=200\nuint16 INVALID_PLANNER=201\nuint16 TF_ERROR=202\n"
        "uint16 START_OUTSIDE_MAP=203\nuint16 GOAL_OUTSIDE_MAP=204\nuint16 START_OCCUPIED=205\n"
        "uint16 GOAL_OCCUPIED=206\nuint16 TIMEOUT=207\nuint16 NO_VALID_PATH=208\n"
        "nav_msgs/Path path\nbuiltin_interfaces/Duration planning_time\nuint16 error_code\nstring error_msg\n---"
    ),
    "nav2_msgs/action/FollowPath": (
        "nav_msgs/Path path\nstring controller_id\nstring goal_checker_id\nstring progress_checker_id\n---\n"
        "uint16 NONE=0\nuint16 UNKNOWN=100\nuint16 INVALID_CONTROLLER=101\nuint16 TF_ERROR=102\n"
        "uint16 INVALID_PATH=103\nuint16 PATIENCE_EXCEEDED=104\nuint16 FAILED_TO_MAKE_PROGRESS=105\n"
        "uint16 NO_VALID_CONTROL=106\nuint16 CONTROLLER_TIMED_OUT=107\n"
        "std_msgs/Empty result\nuint16 error_code\nstring error_msg\n---\n"
        "float32 distance_to_goal\nfloat32 speed"
    ),
    "nav2_msgs/action/Wait": (
        "builtin_interfaces/Duration time\n---\n"
        "uint16 NONE=0\nuint16 UNKNOWN=740\nuint16 TIMEOUT=741\n"
        "builtin_interfaces/Duration total_elapsed_time\nuint16 error_code\nstring error_msg\n---\n"
        "builtin_interfaces/Duration time_left"
    ),
    "control_msgs/action/FollowJointTrajectory": (
        "trajectory_msgs/JointTrajectory trajectory\ntrajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory\n"
        "control_msgs/JointTolerance[] path_tolerance\n"
        "control_msgs/JointComponentTolerance[] component_path_tolerance\n"
        "control_msgs/JointTolerance[] goal_tolerance\n"
        "control_msgs/JointComponentTolerance[] component_goal_tolerance\n"
        "builtin_interfaces/Duration goal_time_tolerance\n---\n"
        "int32 error_code\nint32 SUCCESSFUL=0\nint32 INVALID_GOAL=-1\nint32 INVALID_JOINTS=-2\n"
        "int32 OLD_HEADER_TIMESTAMP=-3\nint32 PATH_TOLERANCE_VIOLATED=-4\nint32 GOAL_TOLERANCE_VIOLATED=-5\n"
        "string error_string\n---\n"
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint desired\n"
        "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error\n"
        "string[] multi_dof_joint_names\ntrajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired\n"
        "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual\n"
        "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error"
    ),
    "control_msgs/action/GripperCommand": (
        "control_msgs/GripperCommand command\n---\n"
        "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n---\n"
        "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal"
    ),
}
"""``package/action/Name`` -> goal, result and feedback fields, separated by lines of three dashes."""

MSG_DEFINITIONS: dict[str, str] = {
    "control_msgs/msg/JointTolerance": "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n",
    "control_msgs/msg/JointComponentTolerance": (
        "uint16 X_AXIS=1\nuint16 Y_AXIS=2\nuint16 Z_AXIS=3\nuint16 TRANSLATION=4\nuint16 ROTATION=5\n"
        "string joint_name\nuint16 component\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
    ),
    "control_msgs/msg/GripperCommand": "float64 position\nfloat64 max_effort\n",
}
"""Messages that these actions are made of and that the typestore does not have."""


def struct_texts(name: str, text: str) -> dict[str, str]:
    """Return the definitions of the eight messages that carry an action, by type name.

    Source: https://design.ros2.org/articles/actions.html; the names are those that the ROS 2 generators use.

    Args:
        name: ``package/action/Name``.
        text: goal, result and feedback fields.
    """
    goal, result, feedback = (part.strip() for part in text.split("---"))
    return {
        f"{name}_Goal": goal,
        f"{name}_Result": result,
        f"{name}_Feedback": feedback,
        f"{name}_SendGoal_Request": f"unique_identifier_msgs/UUID goal_id\n{name}_Goal goal",
        f"{name}_SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
        f"{name}_GetResult_Request": "unique_identifier_msgs/UUID goal_id",
        f"{name}_GetResult_Response": f"int8 status\n{name}_Result result",
        f"{name}_FeedbackMessage": f"unique_identifier_msgs/UUID goal_id\n{name}_Feedback feedback",
    }
