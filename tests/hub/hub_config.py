"""The documented configuration, with what only a test may have: one password for all, and a proxy of its own."""

import os
import shutil

c = get_config()  # noqa: F821
load_subconfig("/srv/robotbrain/hub/jupyterhub_config.py")  # noqa: F821

c.JupyterHub.authenticator_class = "dummy"
c.DummyAuthenticator.password = "proof"
c.ConfigurableHTTPProxy.command = [shutil.which("node"), os.environ["PROXY"]]
c.JupyterHub.db_url = "sqlite:////srv/proof/jupyterhub.sqlite"
c.JupyterHub.cookie_secret_file = "/srv/proof/cookie_secret"
c.ConfigurableHTTPProxy.pid_file = "/srv/proof/proxy.pid"
c.Spawner.environment.update(PYTHONPATH=os.environ["PYTHONPATH"])  # on a real machine the kit is installed
