"""Starts a user's own server: first makes a student's copy of the course, if there is none yet.

It runs as that user, so it can do nothing that the user could not. Labs are left out of the copy: they are fetched
through Nbgrader > Assignment List when they are released.
"""

import os
import shutil
import sys
from pathlib import Path


def main() -> None:
    """``start.py COURSE …``: the rest of the command line is the server's."""
    source, folder = Path(sys.argv[1]), Path(os.environ["ROBOTBRAIN_HUB_FOLDER"])
    if not folder.exists():
        # Under another name until it is complete: a server that is stopped meanwhile starts afresh.
        unfinished = folder.with_name(f".{folder.name}.{os.getpid()}")
        shutil.copytree(source, unfinished, ignore=shutil.ignore_patterns("labs", "src", "autograder", "__pycache__"))
        (unfinished / "labs").mkdir()
        unfinished.chmod(0o700)
        unfinished.rename(folder)
    command = [sys.executable, "-m", "jupyterhub.singleuser", *sys.argv[2:]]
    os.execv(sys.executable, command)


if __name__ == "__main__":
    main()
