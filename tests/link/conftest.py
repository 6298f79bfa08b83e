"""Makes ``rclpy`` and the interface packages importable, as a student's ``import robotbrain.ros`` does."""

from __future__ import annotations

import robotbrain.ros  # noqa: F401
