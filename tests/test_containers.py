"""Binder, Dev Container and JupyterHub files: what can be said of them without an image or a hub.

``python -m tests.hub`` runs a genuine hub with the last ones.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from robotbrain.bundle.contents import collect
from robotbrain.grading.course import find_course
from robotbrain.jupyter import LANDING

# https://containers.dev/implementors/json_reference, as of November 2026
KNOWN = {"name", "image", "hostRequirements", "containerEnv", "postCreateCommand", "forwardPorts", "portsAttributes"}
KNOWN |= {"customizations", "features", "remoteUser"}


@pytest.fixture(scope="module")
def container(repo: Path) -> dict:
    return json.loads((repo / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))


def linux_setup(repo: Path) -> str:
    text = (repo / "src" / "robotbrain" / "bundle" / "STUDENT_README.md").read_text(encoding="utf-8")
    found = re.search(r"\*\*Linux\*\*\s+```\n(.*)\n", text)
    assert found
    return found[1]


def test_both_use_a_python_that_the_package_allows(repo: Path, container: dict) -> None:
    from packaging.specifiers import SpecifierSet

    project = tomllib.loads((repo / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    binder = (repo / "binder" / "runtime.txt").read_text(encoding="utf-8").strip().removeprefix("python-")
    image = re.search(r"python:([\d.]+)-", container["image"])
    assert image and image[1] == binder and SpecifierSet(project["requires-python"]).contains(binder)


def test_both_install_as_the_readme_says(repo: Path, container: dict) -> None:
    assert container["postCreateCommand"] == linux_setup(repo)
    asked = [line for line in (repo / "binder" / "requirements.txt").read_text(encoding="utf-8").splitlines() if line]
    options = dict(line.split(" ", 1) for line in asked if not line.startswith("#"))
    words = linux_setup(repo).split()
    assert options["--extra-index-url"] == words[words.index("--extra-index-url") + 1]
    assert options["--editable"] == "." and (repo / "binder" / options["--constraint"]).resolve().is_file()


def test_the_dev_container_names_what_its_specification_knows(container: dict) -> None:
    assert set(container) <= KNOWN and container["forwardPorts"] == [8888]
    assert set(container["portsAttributes"]) == {"8888"}
    settings = container["customizations"]["vscode"]["settings"]
    assert settings["python.defaultInterpreterPath"].endswith("/.venv/bin/python")


@pytest.mark.skipif(sys.platform == "win32", reason="these scripts run in Linux containers")
def test_scripts_of_binder_can_be_run(repo: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    for name in ("postBuild", "start"):
        script = repo / "binder" / name
        subprocess.run([bash, "-n", str(script)], check=True)
        text = script.read_bytes()
        assert text.startswith(b"#!") and b"\r" not in text and script.stat().st_mode & 0o111
    path = Path(sys.executable).parent
    environment = {"PATH": f"{path}:/usr/bin:/bin", "HOME": str(repo)}
    show = [bash, "binder/start", sys.executable, "-c", "import os; print(os.environ['JUPYTER_CONFIG_PATH'])"]
    done = subprocess.run(show, cwd=repo, env=environment, capture_output=True, text=True, check=True)
    assert (Path(done.stdout.strip()) / "nbgrader_config.json").is_file()


def test_a_public_repository_can_be_made_of_the_bundle(repo: Path) -> None:
    """Binder shows the whole repository that it starts from: for students that must be the bundle."""
    names = {item.name for item in collect(find_course(repo))}
    folders = ("binder", ".devcontainer")
    assert {p.relative_to(repo).as_posix() for folder in folders for p in (repo / folder).iterdir()} <= names
    assert LANDING in names
    assert f"urlpath=lab/tree/{LANDING}" in (repo / "autograder" / "JUPYTERHUB.md").read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="JupyterHub runs on Linux and macOS")
def test_the_hub_gives_formgrader_to_instructors_only(repo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from traitlets.config import PyFileConfigLoader

    monkeypatch.setenv("ROBOTBRAIN_INSTRUCTORS", "ada grace")
    monkeypatch.setattr("pwd.getpwnam", lambda name: SimpleNamespace(pw_dir=f"/homes/{name}"))
    config = PyFileConfigLoader("jupyterhub_config.py", path=str(repo / "autograder" / "jupyterhub")).load_config()
    made = {}
    for name in ("ada", "alan"):
        spawner = SimpleNamespace(user=SimpleNamespace(name=name), environment=dict(config.Spawner.environment))
        config.Spawner.pre_spawn_hook(spawner)
        made[name] = spawner
        assert spawner.environment["ROBOTBRAIN_EXCHANGE"] == "/srv/robotbrain/exchange"
    assert made["ada"].notebook_dir == "/homes/ada/robotbrain" and "formgrader" in made["ada"].default_url
    assert "/homes/ada/robotbrain/autograder" in made["ada"].environment["JUPYTER_CONFIG_PATH"]
    assert made["alan"].default_url == f"/lab/tree/{LANDING}"
    assert "autograder" not in made["alan"].environment["JUPYTER_CONFIG_PATH"]
    assert made["alan"].environment["ROBOTBRAIN_LABS"] == "/homes/alan/robotbrain-course/labs"
    assert config.Authenticator.admin_users == set()


@pytest.mark.skipif(sys.platform == "win32", reason="JupyterHub runs on Linux and macOS")
def test_a_student_of_the_hub_gets_a_copy_once(repo: Path, tmp_path: Path) -> None:
    start = repo / "autograder" / "jupyterhub" / "start.py"
    source, folder = tmp_path / "source", tmp_path / "home" / "robotbrain-course"
    for name in ("course/a.ipynb", "labs/one/one.ipynb", "src/x.py", "README.md"):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text("as given", encoding="utf-8")
    # In the place of the server: a module that only says that it was started.
    (tmp_path / "jupyterhub").mkdir()
    (tmp_path / "jupyterhub" / "__init__.py").touch()
    (tmp_path / "jupyterhub" / "singleuser.py").write_text("import sys; print(sys.argv[1:])", encoding="utf-8")
    folder.parent.mkdir()
    environment = os.environ | {"ROBOTBRAIN_HUB_FOLDER": str(folder), "PYTHONPATH": str(tmp_path)}
    for _ in range(2):
        command = [sys.executable, str(start), str(source), "--port=1"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == "['--port=1']"
        assert {p.name for p in folder.iterdir()} == {"course", "labs", "README.md"}
        assert not list((folder / "labs").iterdir()) and folder.stat().st_mode & 0o777 == 0o700
        (folder / "course" / "a.ipynb").write_text("worked on", encoding="utf-8")
    assert (folder / "course" / "a.ipynb").read_text(encoding="utf-8") == "worked on"
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]
