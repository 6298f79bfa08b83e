"""Import this before nbformat in a short-lived process.

nbformat imports jsonschema, which compiles a grammar for internationalised addresses (rfc3987-syntax, where installed;
JupyterLab brings it) and so takes more than a second, once per submission. No notebook needs that check, and
jsonschema does without it where the package is missing: here it is made to look missing.
"""

from __future__ import annotations

import sys

if "jsonschema" not in sys.modules:
    sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
