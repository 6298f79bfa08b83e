"""Watching a robot brain: what it does, how long that takes, where the time goes, and what would help."""
