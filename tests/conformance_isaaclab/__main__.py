"""``python -m tests.conformance_isaaclab``."""

from __future__ import annotations

import sys

from tests.conformance_isaaclab.run import main

sys.exit(main())
