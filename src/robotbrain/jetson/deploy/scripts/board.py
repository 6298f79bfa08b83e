"""Start the board's program: python3 board.py check, build or run."""

import sys

from program.main import main  # type: ignore[import-not-found]  # it lies beside this file in a bundle

sys.exit(main(sys.argv[1:]))
