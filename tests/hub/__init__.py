"""A genuine JupyterHub with three users on one machine: ``python -m tests.hub`` (as root, on Linux)."""
