"""Makes ``rclpy`` and the interface packages importable, as a student's ``import robotbrain.ros`` does."""

from __future__ import annotations

import os

import robotbrain.ros  # noqa: F401

# Against genuine ROS 2, which needs an environment of its own: `make conformance-ros` makes one and runs these.
collect_ignore = [] if "ROBOTBRAIN_GENUINE_PYTHON" in os.environ else ["test_genuine.py"]
