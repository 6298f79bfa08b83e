"""``robotbrain lab`` up to the start of the server: where the course is, and what Jupyter is told."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import pytest
from traitlets.config import Config

from robotbrain import jupyter
from robotbrain.errors import InputError


@pytest.fixture
def course(tmp_path: Path) -> Path:
    root = tmp_path / "my course"
    (root / "labs" / "lab_integration").mkdir(parents=True)
    (root / "course").mkdir()
    (root / jupyter.LANDING).write_text("{}")
    return root


@pytest.fixture
def user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The configuration folder of a user who turned everything off that the kit needs."""
    config = tmp_path / "user"
    for name, content in {
        "jupyter_server_config.d/mine.json": {
            "ServerApp": {"jpserver_extensions": {"nbgrader.server_extensions.validate_assignment": False}}
        },
        "nbgrader_config.json": {"Execute": {"timeout": 1}, "Validator": {"width": 77}},
        "labconfig/page_config.json": {"disabledExtensions": {"@jupyterlab/toc-extension": True}},
    }.items():
        (config / name).parent.mkdir(parents=True, exist_ok=True)
        (config / name).write_text(json.dumps(content))
    monkeypatch.setenv("JUPYTER_CONFIG_DIR", str(config))
    monkeypatch.delenv("JUPYTER_CONFIG_PATH", raising=False)
    for name, value in jupyter.server_environment(os.environ, config).items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    return config


def test_course_is_found_from_any_folder_in_it(course: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert jupyter.find_course(course) == course
    assert jupyter.find_course(course / "labs" / "lab_integration") == course
    monkeypatch.chdir(course / "labs")
    assert jupyter.find_course() == course


def test_elsewhere_the_installed_checkout_is_opened(
    repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jupyter, "__file__", str(repo / "src" / "robotbrain" / "jupyter.py"))
    assert jupyter.find_course() == repo


@pytest.mark.parametrize("missing", ["labs", "landing", "folder"])
def test_a_folder_without_course_is_refused_in_words(course: Path, missing: str) -> None:
    target = course
    if missing == "labs":
        (course / "labs").rename(course / "elsewhere")
    elif missing == "landing":
        (course / jupyter.LANDING).unlink()
    else:
        target = course.parent / "nowhere"
    with pytest.raises(InputError, match="--directory"):
        jupyter.find_course(target)


@pytest.mark.parametrize("port", ["0", "65536", "-1", "http"])
def test_a_wrong_port_is_refused(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    jupyter.add_arguments(parser)
    with pytest.raises(SystemExit):
        parser.parse_args([f"--port={port}"])
    assert "--port" in capsys.readouterr().err


def test_a_given_port_is_the_only_one_tried(course: Path) -> None:
    assert {"--ServerApp.port=9001", "--ServerApp.port_retries=0"} <= set(jupyter.server_arguments(course, port=9001))
    assert not [a for a in jupyter.server_arguments(course) if ".port" in a]


def test_other_configuration_folders_stay_on_the_search_path() -> None:
    path = jupyter.server_environment({"JUPYTER_CONFIG_PATH": "theirs"}, Path("here"))["JUPYTER_CONFIG_PATH"]
    assert path.split(os.pathsep) == [str(jupyter.CONFIG), "theirs"]


def test_instructor_gets_formgrader_on_the_courses_gradebook(course: Path) -> None:
    path = jupyter.server_environment({}, course, instructor=True)["JUPYTER_CONFIG_PATH"].split(os.pathsep)
    assert path[-3:] == [str(jupyter.INSTRUCTOR), str(course / "autograder"), str(jupyter.CONFIG)]
    assert "--LabApp.default_url=/lab?formgrader=true" in jupyter.server_arguments(course, instructor=True)


def test_a_students_copy_opens_no_formgrader(course: Path) -> None:
    arguments = argparse.Namespace(directory=course, instructor=True, exchange=None, port=None, no_browser=True)
    with pytest.raises(InputError, match="--instructor"):
        jupyter.main(arguments)


def test_exchange_that_is_named_must_be_there(course: Path) -> None:
    arguments = argparse.Namespace(
        directory=course, instructor=False, exchange=str(course / "no"), port=None, no_browser=True
    )
    with pytest.raises(InputError, match="exchange: got"):
        jupyter.main(arguments)


def test_assignment_list_fetches_into_labs_from_the_exchange(user: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nbgrader.apps import NbGrader

    for name, value in jupyter.server_environment({}, user, "/an/exchange").items():
        monkeypatch.setenv(name, value)
    app = NbGrader()
    app.load_config_file()
    assert (app.config.Exchange.root, app.config.Exchange.assignment_dir) == ("/an/exchange", str(user / "labs"))


def test_on_windows_the_assignment_list_is_hidden(course: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jupyter.sys, "platform", "win32")
    first = jupyter.server_environment({}, course)["JUPYTER_CONFIG_PATH"].split(os.pathsep)[0]
    page = json.loads((Path(first) / "labconfig" / "page_config.json").read_text())
    assert page["disabledExtensions"] == {"@jupyter/nbgrader:assignment-list": True}


def test_validate_gets_the_kits_settings_and_keeps_the_users_others(user: Path) -> None:
    from nbgrader.apps import NbGrader

    app = NbGrader()
    app.load_config_file()  # as nbgrader's handler of the Validate button does
    assert app.config.Execute.timeout == 300
    assert app.config.Execute.skip_cells_with_tag == "skip-grading"
    assert app.config.Validator.width == 77


def test_validate_and_grading_agree(repo: Path, user: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from traitlets.config import PyFileConfigLoader

    monkeypatch.setenv("ROBOTBRAIN_AUTOGRADER", "")  # the configuration may set it: put it back afterwards
    monkeypatch.setenv("PATH", os.environ["PATH"])
    grading: Config = PyFileConfigLoader("nbgrader_config.py", path=str(repo / "autograder")).load_config()
    students = json.loads((jupyter.CONFIG / "nbgrader_config.json").read_text())
    assert {name: grading.Execute[name] for name in students["Execute"]} == students["Execute"]


def test_students_extensions_are_on_whatever_the_user_turned_off(user: Path) -> None:
    from jupyter_server.extension.config import ExtensionConfigManager
    from jupyter_server.serverapp import ServerApp

    found = ExtensionConfigManager(read_config_path=ServerApp().config_file_paths).get_jpserver_extensions()  # type: ignore[no-untyped-call]
    assert found["nbgrader.server_extensions.validate_assignment"] is True
    assert found["nbgrader.server_extensions.assignment_list"] is True


def test_what_is_for_instructors_is_hidden_and_the_users_choices_stay(user: Path) -> None:
    from jupyterlab_server.config import get_static_page_config

    disabled = get_static_page_config(level="all")["disabledExtensions"]
    assert disabled["@jupyter/nbgrader:formgrader"] is disabled["@jupyter/nbgrader:create-assignment"] is True
    assert "@jupyter/nbgrader:assignment-list" not in disabled
    assert disabled["@jupyterlab/toc-extension"] is True
    assert "@jupyter/nbgrader:validate-assignment" not in disabled
