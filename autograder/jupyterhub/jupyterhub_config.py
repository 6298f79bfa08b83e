"""JupyterHub for one course on one machine; JUPYTERHUB.md beside this folder says how to set it up.

    jupyterhub --config autograder/jupyterhub/jupyterhub_config.py

Everybody's server runs as their own system account, which is what nbgrader's exchange rests on. The variables below
say where things are; ``tests/hub`` runs exactly this file.
"""

import os
import sys
from pathlib import Path
from pwd import getpwnam

from robotbrain.jupyter import LANDING, server_environment

c = get_config()

HERE = Path(__file__).resolve().parent
INSTRUCTORS = set(os.environ.get("ROBOTBRAIN_INSTRUCTORS", "instructor").split())
# What `robotbrain bundle` made, unpacked, readable for all. Every student gets a copy of it.
STUDENT_COURSE = Path(os.environ.get("ROBOTBRAIN_STUDENT_COURSE", "/srv/robotbrain/course"))
EXCHANGE = os.environ.get("ROBOTBRAIN_EXCHANGE", "/srv/robotbrain/exchange")
# In an instructor's home: the repository, readable for nobody else. In a student's: the copy.
REPOSITORY, COPY = "robotbrain", "robotbrain-course"

c.JupyterHub.bind_url = "http://127.0.0.1:8000"  # behind a web server that speaks TLS
c.JupyterHub.spawner_class = "jupyterhub.spawner.LocalProcessSpawner"
# PAM, that is the system's accounts, is JupyterHub's default authenticator; OAuth and LTI are a few lines (see the notes).
c.Authenticator.allow_all = True  # everybody whom the authenticator knows; LocalProcessSpawner needs an account, too
c.Authenticator.admin_users = set()  # an instructor need not be able to enter students' servers

# The last words of the single-user server's command line decide, so students cannot reach beyond their own folder by
# accident; what they must not read is closed by file permissions, not by this.
c.Spawner.cmd = [sys.executable, str(HERE / "start.py"), str(STUDENT_COURSE)]
c.Spawner.http_timeout = c.Spawner.start_timeout = 120
c.Spawner.environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # a class shares the processors
c.Spawner.env_keep = ["PATH", "LANG", "LC_ALL", "VIRTUAL_ENV"]


def prepare(spawner):
    """Give each server the kit's configuration: an instructor's has formgrader and the gradebook, a student's has not."""
    teaches = spawner.user.name in INSTRUCTORS
    folder = Path(getpwnam(spawner.user.name).pw_dir) / (REPOSITORY if teaches else COPY)
    spawner.environment = {
        **spawner.environment,
        **server_environment({}, folder, EXCHANGE, instructor=teaches),
        "ROBOTBRAIN_HUB_FOLDER": str(folder),
    }
    spawner.notebook_dir = str(folder)
    spawner.default_url = "/lab?formgrader=true" if teaches else f"/lab/tree/{LANDING}"


c.Spawner.pre_spawn_hook = prepare
