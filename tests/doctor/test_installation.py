"""``robotbrain doctor`` in installations that are really broken: it names fault and cure, and does not fall ill."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from robotbrain.doctor.probes import PROBES
from robotbrain.doctor.probes.libraries import MODULES
from tests.conftest import REPO
from tests.doctor.patient import Patient, make_environment, posix


def test_a_healthy_environment_has_no_fault(patient: Patient) -> None:
    """All probes, on the environment that runs the tests."""
    answer = patient.ask()
    assert answer.code == 0 and not answer.faults()
    assert {finding["probe"] for finding in answer.findings} == set(PROBES)


def test_nothing_but_the_kit_is_installed(patient: Patient) -> None:
    """Every package is missing, Jupyter's too, and every probe still answers."""
    patient.python = make_environment(patient.folder / "empty", packages=False)
    answer = patient.ask()
    assert answer.code == 1
    assert not [f for f in answer.findings if "probe itself failed" in f["what"]]
    missing = answer.one("fault", "required packages are missing", "numpy, ", "torch, ", "mujoco-core, ", "nbgrader, ")
    assert f"{patient.python} -m pip install --editable {REPO}" in missing["cure"]
    assert "pip install packaging" in answer.one("warning", "`packaging` is missing")["cure"]
    assert "jupyterlab" in answer.one("fault", "JupyterLab is missing")["cure"]


def test_a_package_is_too_old_or_known_to_be_bad_or_made_for_another(patient: Patient) -> None:
    site = patient.path_first("site")
    for name, version, more in (
        ("numpy", "1.26.4", ""),
        ("mujoco_core", "4.0.0", ""),
        ("torchvision", "0.15.1", "Requires-Dist: torch==2.0.0\n"),
    ):
        record = site / f"{name}-{version}.dist-info"
        record.mkdir()
        text = f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: {version}\n{more}"
        (record / "METADATA").write_text(text, encoding="utf-8")
    answer = patient.ask("packages")
    assert answer.code == 1
    numpy = answer.one("fault", "numpy 1.26.4 is installed", "needs numpy>=2.1")
    assert "pip install --upgrade 'numpy>=2.1'" in numpy["cure"] and "ABI" in numpy["detail"]
    assert "mujoco-core>=4.0.1" in answer.one("fault", "mujoco-core 4.0.0 computes wrong contact forces")["cure"]
    assert "--upgrade torchvision" in answer.one("fault", "torchvision 0.15.1 is made for torch==2.0.0")["cure"]


@posix
def test_a_few_packages_are_missing(patient: Patient) -> None:
    """An environment with links to the packages of this one, but not to all."""
    patient.python = make_environment(patient.folder / "some", packages=False)
    inside = next((patient.folder / "some" / "lib").glob("python3*/site-packages"))
    for site in (Path(p) for p in sys.path if p.endswith("site-packages")):
        for entry in site.iterdir():
            if not entry.name.startswith(("rosbags", "onnxruntime")) and not (inside / entry.name).exists():
                (inside / entry.name).symlink_to(entry)
    answer = patient.ask("packages")
    assert "-m pip install 'onnxruntime>=1.23'" in answer.one("fault", "onnxruntime is missing")["cure"]
    assert "-m pip install 'rosbags>=0.11'" in answer.one("fault", "rosbags is missing")["cure"]
    assert len(answer.faults()) == 2


def test_packages_that_crash_hang_or_lack_a_library(patient: Patient) -> None:
    """One takes the interpreter down, one never returns, one lacks libGL; the others are still looked at."""
    site = patient.path_first("site")
    for module in {m.partition(".")[0] for m in MODULES.values()}:  # light ones, so that this stays cheap
        (site / f"{module}.py").write_text("", encoding="utf-8")
    (site / "meshcat.py").write_text("import os\nos.abort()", encoding="utf-8")
    (site / "msgpack.py").write_text("import time\ntime.sleep(600)", encoding="utf-8")
    broken = "libGL.so.1: cannot open shared object file: No such file or directory"
    (site / "rosbags.py").write_text(f"raise ImportError({broken!r})", encoding="utf-8")
    (site / "tqdm.py").write_text("raise SystemExit('tqdm leaves')", encoding="utf-8")
    answer = patient.ask("libraries", timeout=8)
    assert answer.code == 1
    crash = answer.one("fault", "meshcat", "takes Python down when it is imported")
    assert "--force-reinstall" in crash["cure"] and crash["cure"].endswith("meshcat")
    assert "msgpack" in answer.one("fault", "msgpack", "hangs when it is imported")["cure"]
    missing = answer.one("fault", "rosbags", "cannot be imported")
    assert "libGL.so.1" in missing["detail"]
    assert sys.platform != "linux" or "apt install libgl1" in missing["cure"]
    assert "tqdm leaves" in answer.one("fault", "tqdm", "cannot be imported")["detail"]
    assert not [f for f in answer.findings if "psutil" in f["what"]]  # after msgpack in the alphabet, and fine


def test_an_environment_that_was_moved(patient: Patient) -> None:
    patient.python = make_environment(patient.folder / "moved", packages=True)
    script = Path(patient.python).parent / "jupyter"
    script.write_text("#!/gone/with/the/wind/bin/python\n", encoding="utf-8")
    finding = patient.ask("environment").one("fault", "/gone/with/the/wind/bin/python", "moved or copied")
    assert "-m venv" in finding["cure"] and str(patient.folder / "moved") in finding["cure"]


def test_another_environment_comes_first_on_path(patient: Patient) -> None:
    patient.python = make_environment(patient.folder / "mine", packages=True)
    other = make_environment(patient.folder / "other", packages=True)
    patient.environment["PATH"] = str(Path(other).parent)
    finding = patient.ask("environment").one("warning", "`python` in this terminal is", str(Path(other).parent))
    assert str(Path(patient.python).parent / "activate") in finding["cure"] or sys.platform == "win32"


@posix
def test_alembic_is_nowhere_and_the_lab_extension_is_missing(patient: Patient) -> None:
    patient.python = make_environment(patient.folder / "bare", packages=True)
    patient.environment["PATH"] = str(patient.folder)
    answer = patient.ask("nbgrader", "extensions")
    assert "--force-reinstall --no-cache-dir alembic" in answer.one("fault", "`alembic` is missing")["cure"]
    assert "nbgrader" in answer.one("fault", "JupyterLab extension is not in this environment")["cure"]


def test_extensions_are_turned_off_by_a_configuration(patient: Patient) -> None:
    settings = patient.folder / "settings"
    (settings / "labconfig").mkdir(parents=True)
    patient.environment["JUPYTER_CONFIG_DIR"] = str(settings)
    name = "nbgrader.server_extensions.validate_assignment"
    off = {"ServerApp": {"jpserver_extensions": {name: False}}}
    file = settings / "jupyter_server_config.json"
    file.write_text(json.dumps(off), encoding="utf-8")
    page = {"disabledExtensions": {"@jupyter/nbgrader:assignment-list": True}}
    (settings / "labconfig" / "page_config.json").write_text(json.dumps(page), encoding="utf-8")
    answer = patient.ask("extensions")
    server = answer.one("fault", "server extension for the Validate button", str(file))
    assert f'In {file} change "{name}": false' in server["cure"]
    lab = answer.one("fault", "JupyterLab extension for the list of assignments", "page_config.json")
    assert 'take "@jupyter/nbgrader:assignment-list" out of "disabledExtensions"' in lab["cure"]
    # The cure is carried out, and cures.
    file.write_text(file.read_text(encoding="utf-8").replace(f'"{name}": false', f'"{name}": true'), encoding="utf-8")
    assert not [f for f in patient.ask("extensions").findings if "the Validate button" in f["what"]]


def test_settings_of_jupyter_are_no_json(patient: Patient) -> None:
    patient.environment["JUPYTER_CONFIG_DIR"] = str(patient.folder)
    (patient.folder / "jupyter_server_config.json").write_text('{"ServerApp": ', encoding="utf-8")
    finding = patient.ask("jupyter").one("fault", "jupyter_server_config.json are no JSON")
    assert "jupyter_server_config.json.broken" in finding["cure"]


def test_a_kernel_whose_python_is_gone_and_one_without_the_kit(patient: Patient) -> None:
    data = patient.folder / "data"
    patient.environment |= {"JUPYTER_DATA_DIR": str(data), "JUPYTER_PREFER_ENV_PATH": "0"}
    gone = str(patient.folder / "deleted" / "bin" / "python")
    empty = patient.folder / "empty"
    other = make_environment(empty, packages=False)
    next(empty.rglob("others.pth")).unlink()
    for name, program in (("python3", other), ("old-project", gone)):
        (data / "kernels" / name).mkdir(parents=True)
        spec = {"argv": [program, "-m", "ipykernel_launcher"], "display_name": name, "language": "python"}
        (data / "kernels" / name / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    answer = patient.ask("kernels")
    wrong = answer.one("fault", "the kernel python3", other, "cannot import robotbrain")
    assert "-m ipykernel install --sys-prefix --name python3" in wrong["cure"]
    assert str(data / "kernels" / "old-project") in answer.one("warning", "old-project", gone, "not exist")["cure"]
    # The same for the kernel that the notebooks ask for.
    spec["argv"][0] = gone
    (data / "kernels" / "python3" / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    assert "ipykernel install" in patient.ask("kernels").one("fault", "the kernel python3", gone)["cure"]


def test_a_configuration_of_nbgrader_that_does_not_load(patient: Patient) -> None:
    config = patient.course / "autograder" / "nbgrader_config.py"
    config.write_text("c = get_config()\nimport no_such_module\n", encoding="utf-8")
    finding = patient.ask("nbgrader").one("fault", "configuration", str(config), "cannot be loaded")
    assert "no_such_module" in finding["detail"] and "git checkout autograder/nbgrader_config.py" in finding["cure"]


def test_the_exchange_does_not_exist(patient: Patient) -> None:
    patient.environment["ROBOTBRAIN_EXCHANGE"] = str(patient.folder / "nowhere")
    if sys.platform == "win32":
        pytest.skip("nbgrader has no exchange on Windows")
    cure = patient.ask("nbgrader").one("fault", "exchange", "nowhere", "does not exist")["cure"]
    assert "chmod ugo+rwx" in cure and "ROBOTBRAIN_EXCHANGE" in cure
