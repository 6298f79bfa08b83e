"""The lab's planner, unchanged, drives the robot over genuine ROS 2: three processes, and a replay on the kit.

``python -m tests.conformance_ros.drive``.
"""
