"""The brain's nodes. Each talks by topics and services only, and any of them can be replaced by a student's."""

# Makes `import rclpy` and the message packages resolve, where genuine ROS 2 is not installed.
import robotbrain.ros  # noqa: F401
