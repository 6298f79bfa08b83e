"""Measuring a network on a real Jetson: running trtexec, reading its log and the board's sensors."""
