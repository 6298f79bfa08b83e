"""The kit's terms, configurations and exported tasks against genuine Isaac Lab: ``make conformance-isaaclab``."""
