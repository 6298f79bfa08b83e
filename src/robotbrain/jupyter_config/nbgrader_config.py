"""Where the assignment list looks: what `robotbrain lab` found out, as nbgrader reads it."""

import os

c = get_config()  # type: ignore[name-defined]  # noqa: F821

if exchange := os.environ.get("ROBOTBRAIN_EXCHANGE"):
    c.Exchange.root = exchange
if labs := os.environ.get("ROBOTBRAIN_LABS"):
    c.Exchange.assignment_dir = labs
