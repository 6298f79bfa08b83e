"""Make the sample class: ``python autograder/sample_class/make.py lab_integration --out DIR``.

The same as ``robotbrain sample-class``; what each submission is stands in ``DIR/class.json``.
"""

from __future__ import annotations

import sys

from robotbrain.cli import main

if __name__ == "__main__":
    sys.exit(main(["sample-class", *sys.argv[1:]]))
