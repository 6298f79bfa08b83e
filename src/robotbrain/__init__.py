"""robotbrain: a course and autograded lab kit on AI-robot brains.

Importing this package is cheap; heavy libraries (torch, mujoco, onnxruntime) load where they are used.
"""

import os

# ONNX Runtime's official builds report usage by default, and decide when they are imported. Students did not agree to
# that; whoever wants it sets the variable to 0 before.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"
