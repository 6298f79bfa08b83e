"""Which folder nbgrader's exchange is on this machine: labs are fetched from it and handed in to it.

It is the folder that ``ROBOTBRAIN_EXCHANGE`` names; else ``Exchange.root`` of an nbgrader configuration on Jupyter's
path (a JupyterHub has one); else nbgrader's own place, if there is such a folder; else a folder of the user's own. The
last is for somebody who learns alone, or tries the course out: only they can reach it.
"""

from __future__ import annotations

import logging
import os
import stat
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robotbrain.errors import InputError

EXCHANGE_VARIABLE = "ROBOTBRAIN_EXCHANGE"
STANDARD = Path("/usr/local/share/nbgrader/exchange")


@dataclass(frozen=True)
class Exchange:
    """The folder of the exchange, why it is this one, and whether it is a user's own."""

    path: Path
    why: str
    own: bool = False

    def usable(self) -> Path:
        """Return the folder, made if it is the user's own.

        Raises:
            InputError: it is not there, or not writable, or this is Windows.
        """
        if sys.platform == "win32":
            raise InputError(
                "exchange",
                given="Windows",
                expected="Linux or macOS: nbgrader's exchange rests on their file permissions",
                fix="Hand in the notebook through your learning platform, or work on a JupyterHub.",
            )
        if self.own:
            self.path.mkdir(parents=True, exist_ok=True)
            self.path.parent.chmod(stat.S_IRWXU)  # nbgrader opens the exchange itself to everybody
        if not self.path.is_dir():
            raise InputError(
                "exchange",
                given=str(self.path),
                expected=f"a folder that is there ({self.why})",
                fix=f"Make it (`mkdir -p`, `chmod ugo+rwx`), or name another in {EXCHANGE_VARIABLE}.",
            )
        if not os.access(self.path, os.W_OK | os.X_OK):
            raise InputError(
                "exchange",
                given=str(self.path),
                expected=f"a folder that you may write to ({self.why})",
                fix=f"Ask whoever keeps it for `chmod ugo+rwx`, or name another in {EXCHANGE_VARIABLE}.",
            )
        return self.path


def find_exchange(environment: Mapping[str, str] | None = None, *, standard: Path = STANDARD) -> Exchange:
    """Return the exchange of this user; it need not be there yet."""
    environment = os.environ if environment is None else environment
    if named := environment.get(EXCHANGE_VARIABLE):
        return Exchange(Path(named).expanduser().resolve(), f"{EXCHANGE_VARIABLE} names it")
    if configured := _configured():
        return Exchange(Path(configured), "an nbgrader configuration names it")
    if standard.is_dir():
        return Exchange(standard, "nbgrader's own place")
    from jupyter_core.paths import jupyter_data_dir

    return Exchange(Path(jupyter_data_dir()) / "robotbrain" / "exchange", "your own, nobody else sees it", own=True)


def _configured() -> str:
    """``Exchange.root`` of the user's own configuration files, or ``""``."""
    from nbgrader.apps import NbGrader

    app = NbGrader(log_level=logging.ERROR)  # no file is no trouble here
    app.load_config_file()
    root = app.config.Exchange.get("root", "")
    return root if isinstance(root, str) else ""
