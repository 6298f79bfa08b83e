"""Makes ``import rclpy`` and the message packages resolve to the kit before the tests are collected."""

from __future__ import annotations

import robotbrain.ros

__all__ = ["robotbrain"]
