"""robotbrain: a course and autograded lab kit on AI-robot brains.

Importing this package is cheap; heavy libraries (torch, mujoco, onnxruntime) load where they are used.
"""

__version__ = "0.1.0"
