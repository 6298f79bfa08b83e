"""``python -m tests.conformance_ros``."""

from __future__ import annotations

import sys

from tests.conformance_ros.run import main

sys.exit(main())
