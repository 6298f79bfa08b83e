"""The students' zip: what is in it, that the key is not, that it is the same everywhere, and that it works."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import nbformat
import pytest

from robotbrain.assessment.bank import Bank, load_bank, practice_bank
from robotbrain.assessment.marking import reasons
from robotbrain.bundle.archive import CHECKSUMS, checksums, pack
from robotbrain.bundle.commands import FOLDER, entry_time
from robotbrain.bundle.contents import Item, check_labs, collect, last_change, tracked_files
from robotbrain.bundle.key import PUBLIC, Key
from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.grading.course import Course, find_course, generate
from tests.conftest import need

WHEN = 1_767_225_600


@pytest.fixture(scope="module")
def course(repo: Path) -> Course:
    return find_course(repo)


@pytest.fixture(scope="module")
def items(course: Course) -> list[Item]:
    return collect(course)  # by the rules alone: what is under version control is another test's


@pytest.fixture(scope="module")
def key(course: Course) -> Key:
    return Key(course)


@pytest.fixture(scope="module")
def unpacked(items: list[Item], tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("student")
    pack([*items, checksums(items)], where / "course.zip", folder=FOLDER, seconds=WHEN)
    with zipfile.ZipFile(where / "course.zip") as archive:
        archive.extractall(where)
    return where / FOLDER


def run(unpacked: Path, code: str, *arguments: str, folder: str = "", timeout: float = 550) -> str:
    """Run ``code`` as a student would who has unpacked the zip: its library, and no course behind it."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("ROBOTBRAIN", "NBGRADER", "PYTHON"))}
    home = unpacked.parent / "home"
    home.mkdir(exist_ok=True)
    environment = kept | {"PYTHONPATH": str(unpacked / "src"), "HOME": str(home), "IPYTHONDIR": str(home / "ipython")}
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=unpacked / folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


# ---------------------------------------------------------------- what is in it


def test_it_holds_the_course_and_nothing_of_instructors(items: list[Item], course: Course) -> None:
    names = {item.name for item in items}
    assert {"README.md", "LICENSE", "pyproject.toml", "constraints.txt", "course/00_welcome.ipynb"} <= names
    assert {f"labs/{lab}/{path.name}" for lab in course.labs() for path in course.sources(lab)} <= names
    tops = {"course", "labs", "src", "autograder", ".devcontainer", "binder"}
    assert {name.split("/")[0] for name in names if "/" in name} <= tops
    assert all(n.startswith("autograder/profiles/") for n in names if n.startswith("autograder/"))
    assert all(n.startswith("src/robotbrain/") for n in names if n.startswith("src/"))
    forbidden = re.compile(
        r"solutions/|hidden/|mutants|styles\.py|draws\.json|paper\.json|gradebook\.db|submitted|\.pyc$"
    )
    assert not [n for n in names if forbidden.search(n)]


def test_links_in_it_lead_somewhere(items: list[Item]) -> None:
    names = {item.name for item in items} | {CHECKSUMS}
    looked = 0
    for item in items:
        if item.name.endswith(".ipynb"):
            cells = json.loads(item.data)["cells"]
            text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        elif item.name.endswith(".md") and not item.name.startswith("src/"):
            text = item.data.decode()
        else:
            continue
        for link in re.findall(r"\]\(([^)\s#]+)[^)]*\)", text):
            if not re.match(r"[a-z]+:|attachment", link):
                looked += 1
                target = os.path.normpath(Path(item.name).parent / link).replace(os.sep, "/")
                assert target in names or any(n.startswith(f"{target}/") for n in names), f"{item.name}: {link}"
    assert looked > 40


def test_its_readme_sets_up_in_two_commands(items: list[Item]) -> None:
    text = next(item.data.decode() for item in items if item.name == "README.md")
    blocks = re.findall(r"\*\*(Linux|macOS|Windows)\*\*.*?```\n(.*?)```", text, flags=re.DOTALL)
    assert [system for system, _ in blocks] == ["Linux", "macOS", "Windows"]
    for _, commands in blocks:
        install, start = commands.splitlines()
        assert "--constraint constraints.txt --editable ." in install and start.endswith("robotbrain lab")


# ---------------------------------------------------------------- the key is not


def test_the_key_is_not_in_it(items: list[Item], key: Key) -> None:
    assert len(key) > 300
    assert not [str(leak) for leak in key.leaks(items)]


def test_every_exception_is_needed(items: list[Item], key: Key) -> None:
    for exception in PUBLIC:
        excused = [item for item in items if fnmatch(item.name, exception.file)]
        assert key.leaks(excused, public=[p for p in PUBLIC if p != exception]), f"{exception} excuses nothing"


def hiding_places(text: str) -> dict[str, bytes]:
    """``text`` as somebody might leave it in a file without noticing."""
    import io

    import onnx

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell("Hello."), nbformat.v4.new_raw_cell(text)])
    output = nbformat.v4.new_output("stream", text=text)
    ran = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1", outputs=[output])])
    network = onnx.ModelProto(producer_name="test")
    network.metadata_props.add(key="note", value=text)
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/b", text)
    coded = base64.b64encode(text.encode()).decode()
    lines = "\n".join(coded[i : i + 76] for i in range(0, len(coded), 76))
    return {
        "a text": f"Some words before.\n{text}\nand after".encode(),
        "other layout": re.sub(r"\s+", "\n  ", text).encode(),
        "quoted in code": f"KEY = {text!r}\n".encode(),
        "quoted, without letters beyond ASCII": json.dumps(re.sub(r"(\w+ \w+) ", "\\1 – ", text)).encode(),
        "a notebook": nbformat.writes(notebook).encode(),
        "an output": nbformat.writes(ran).encode(),
        "a network": network.SerializeToString() + bytes(range(256)),
        "a zip": zipped.getvalue(),
        "a gzip": gzip.compress(text.encode()),
        "base64": f'data = "{coded}"'.encode(),
        "base64 in lines": f"data = (\n{lines}\n)".encode(),
        "a zip in base64": b"x = '" + base64.b64encode(zipped.getvalue()) + b"'",
        "hexadecimal": text.encode().hex().encode(),
    }


def planted(course: Course) -> Iterator[tuple[str, str]]:
    question = load_bank(course.autograder / "assessment").questions[0]
    yield "autograder/assessment", "\n".join([question.text, question.explain, *reasons(question).values()])
    hidden = (course.autograder / "hidden" / "lab_integration.py").read_text(encoding="utf-8")
    yield "autograder/hidden", hidden[hidden.index("def inflate_random") :][:1500]
    cells = nbformat.read(course.sources("lab_integration")[0], as_version=4).cells
    astar = next(c.source for c in cells if c.metadata.get("nbgrader", {}).get("grade_id") == "astar")
    yield "solutions/", astar.partition("### BEGIN SOLUTION")[2].partition("### END")[0]
    mutants = (course.autograder / "mutants" / "lab_integration" / "styles.py").read_text(encoding="utf-8")
    yield "autograder/mutants", mutants[len(mutants) // 3 : len(mutants) // 3 + 4000]


def test_the_key_is_found_wherever_it_hides(course: Course, key: Key) -> None:
    for secret, text in planted(course):
        for place, data in hiding_places(text).items():
            leaks = key.leaks([Item("course/images/picture.png", data)])
            assert any(leak.secret.startswith(secret) for leak in leaks), f"{secret} in {place}"


def test_reference_files_are_known_by_their_bytes(course: Course, key: Key) -> None:
    policy = next((course.autograder / "reference").rglob("*.onnx"))
    (leak,) = key.leaks([Item("labs/hw1_rl/start.onnx", policy.read_bytes())])
    assert leak.secret == policy.relative_to(course.home).as_posix()


def test_a_recorded_draw_is_part_of_the_key(tmp_path: Path) -> None:
    seed = hashlib.sha256(b"a student's seed").hexdigest()[:32]
    (tmp_path / "autograder" / "assessment").mkdir(parents=True)
    record = {"students": {"ada": {"seed": seed, "ids": [], "code": "ABCD"}}}
    (tmp_path / "autograder" / "assessment" / "draws.json").write_text(json.dumps(record), encoding="utf-8")
    own = Key(Course(tmp_path, tmp_path))
    assert own.leaks([Item("course/a.md", f"The seed is {seed}.".encode())])
    assert not own.leaks([Item("course/a.md", b"The seed is 42.")])


def sentences(bank: Bank) -> set[str]:
    return {" ".join(s.split()) for q in bank.questions for s in (q.explain, *reasons(q).values()) if len(s) > 40}


def texts(folder: Path) -> Iterator[tuple[Path, str]]:
    """Every text in a folder: decoded files, and the sources of notebooks as they are read."""
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        text = path.read_bytes().decode("utf-8", "replace")
        if path.suffix == ".ipynb":
            text += "\n".join("".join(c["source"]) for c in json.loads(text)["cells"])
        yield path, text


def test_no_file_of_it_says_what_the_key_says(unpacked: Path, course: Course) -> None:
    """Another way than the command's own: whole sentences, functions and solutions, apart from spaces."""
    secret = sentences(load_bank(course.autograder / "assessment")) - sentences(practice_bank())
    assert len(secret) > 200
    for path in (course.autograder / "hidden").glob("*.py"):
        secret |= {part for part in path.read_text(encoding="utf-8").split("\n\n\n") if part.startswith("@suite.test")}
    for lab in course.labs():
        for cell in nbformat.read(course.sources(lab)[0], as_version=4).cells:
            secret |= set(re.findall(r"### BEGIN SOLUTION\n(.*?)### END", cell.source, re.DOTALL))
    packed = {"".join(text.split()): text for text in secret if len(text) > 80}
    assert len(packed) > 250
    for path, text in texts(unpacked):
        whole = "".join(text.split())
        found = [original for short, original in packed.items() if short in whole]
        assert not found or path.name == "practice.toml", f"{path.relative_to(unpacked)}: {found[0][:200]}"
        assert not re.search(r"### (BEGIN|END) HIDDEN|### BEGIN SOLUTION\n", text) or path.suffix == ".py", path


IMPORTS = """
import importlib, inspect, json, os, pkgutil, sys, types
import robotbrain
needs, strings, loaded = {}, set(), 0
for info in pkgutil.walk_packages(robotbrain.__path__, "robotbrain."):
    if info.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(info.name)
        loaded += 1
    except ImportError as error:
        needs[info.name] = getattr(error, "package", None) or error.name
def walk(value, depth=0):
    if isinstance(value, str):
        strings.add(" ".join(value.split()))
    elif depth > 6:
        return
    elif isinstance(value, dict):
        for k, v in list(value.items()):
            walk(k, depth + 1), walk(v, depth + 1)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for v in list(value):
            walk(v, depth + 1)
    elif isinstance(value, (types.FunctionType, types.MethodType)):
        walk(value.__code__, depth + 1), walk(value.__doc__)
    elif isinstance(value, types.CodeType):
        walk(value.co_consts, depth)
    elif (type(value).__module__ or "").startswith("robotbrain") or inspect.isclass(value):
        walk(vars(value) if hasattr(value, "__dict__") else {}, depth + 1)
        walk([getattr(value, n, None) for n in getattr(type(value), "__slots__", ())], depth + 1)
from robotbrain.assessment.records import open_paper, recorded_draw
from robotbrain.grading import load_suite, load_hidden_suite
for name, module in list(sys.modules.items()):
    if name.startswith("robotbrain"):
        walk({k: v for k, v in vars(module).items() if not isinstance(v, types.ModuleType)})
hidden = []
for path in pkgutil.iter_modules(importlib.import_module("robotbrain.grading.suites").__path__):
    try:
        load_hidden_suite(path.name)
        hidden.append(path.name)
    except Exception:
        pass
open(sys.argv[1], "w", encoding="utf-8").write(json.dumps(sorted(strings)))
ours = {n: m for n, m in sys.modules.items() if n.startswith("robotbrain")}
places = {n: getattr(m, "__file__", None) or list(m.__path__)[0] for n, m in ours.items()}
outside = [n for n, place in places.items() if not place.startswith(os.getcwd())]
print(json.dumps({"loaded": loaded, "needs": needs, "hidden": hidden, "practice": open_paper().practice,
                  "drawn": recorded_draw("autograder", "ada").paper.practice, "outside": outside}))
"""


def test_importing_everything_finds_no_key(unpacked: Path, course: Course, tmp_path: Path) -> None:
    told = json.loads(run(unpacked, IMPORTS, str(tmp_path / "strings.json")).splitlines()[-1])
    assert told["loaded"] > 500 and told["practice"] and told["drawn"]
    assert told["hidden"] == [] and told["outside"] == []
    assert not [name for name, package in told["needs"].items() if str(package).startswith("robotbrain")]
    known = set(json.loads((tmp_path / "strings.json").read_text(encoding="utf-8")))
    assert len(known) > 5000
    taught = "".join(" ".join(text.split()) for _, text in texts(unpacked / "course"))
    secret = sentences(load_bank(course.autograder / "assessment")) - sentences(practice_bank())
    assert not [s for s in secret & known if s not in taught]
    # What was read is what is asked about: the practice key, which is to be there, is found.
    assert any(s in known for s in sentences(practice_bank()))


# ---------------------------------------------------------------- it works


CHECK = """
import json, sys
lab, exercise, solved = sys.argv[1:]
names = {}
for cell in json.load(open(f"{lab}.ipynb", encoding="utf-8"))["cells"]:
    source = "".join(cell["source"])
    if cell["metadata"].get("nbgrader", {}).get("grade_id") == exercise:
        break
    if cell["cell_type"] == "code":
        exec(source, names)
told = []
for answer in (source, solved):
    exec(answer, names)
    report = names["lab"].check(exercise)
    told.append([report.full, str(report)])
print(json.dumps(told))
"""


def solution(course: Course, lab: str, exercise: str) -> str:
    cells = nbformat.read(course.sources(lab)[0], as_version=4).cells
    return str(next(c.source for c in cells if c.metadata.get("nbgrader", {}).get("grade_id") == exercise))


def test_a_check_fails_with_the_stub_and_passes_with_the_solution(unpacked: Path, course: Course) -> None:
    typed = solution(course, "lab_integration", "preprocess")
    out = run(unpacked, CHECK, "lab_integration", "preprocess", typed, folder="labs/lab_integration")
    stub, solved = json.loads(out.splitlines()[-1])
    assert not stub[0] and "not written yet" in stub[1], stub
    assert solved[0], solved


VALIDATE = """
import json, logging, sys
from nbgrader.validator import Validator
from traitlets.config import Config
from robotbrain.jupyter import CONFIG
settings = Config(json.loads((CONFIG / "nbgrader_config.json").read_text(encoding="utf-8")))
logging.disable(logging.CRITICAL)
print(json.dumps(Validator(config=settings).validate(sys.argv[1])))
"""


def test_validate_runs_in_it(unpacked: Path, course: Course, tmp_path: Path) -> None:
    source = unpacked / "labs" / "assessment" / "assessment.ipynb"
    filled = nbformat.read(source, as_version=4)
    for cell in filled.cells:
        label = cell.metadata.get("nbgrader", {})
        if label.get("solution"):
            cell.source = solution(course, "assessment", label["grade_id"])
    nbformat.write(filled, source.with_name("filled.ipynb"))
    results: dict[str, Any] = {}
    for name in ("assessment", "filled"):
        results[name] = json.loads(run(unpacked, VALIDATE, f"{name}.ipynb", folder="labs/assessment").splitlines()[-1])
    assert len(results["assessment"]["failed"]) == 10, results["assessment"]
    assert "failed" not in results["filled"], results["filled"]


# ---------------------------------------------------------------- the same bytes everywhere


def test_the_same_tree_gives_the_same_bytes(items: list[Item], tmp_path: Path) -> None:
    digests = {
        pack(order, tmp_path / f"{number}" / "a.zip", folder="f", seconds=WHEN)
        for number, order in enumerate((items, items[::-1]))
    }
    (digest,) = digests
    assert digest == hashlib.sha256((tmp_path / "0" / "a.zip").read_bytes()).hexdigest()
    with zipfile.ZipFile(tmp_path / "0" / "a.zip") as archive:
        entries = archive.infolist()
    assert [e.filename for e in entries] == sorted(e.filename for e in entries)
    for entry in entries:
        assert entry.date_time == (2026, 1, 1, 0, 0, 0) and entry.external_attr >> 16 == 0o100644
        assert entry.compress_type == zipfile.ZIP_STORED and entry.extra == b"" and entry.create_system == 3


def test_bytes_are_as_they_were_when_this_was_written(tmp_path: Path) -> None:
    """Whatever the system, the version of Python and of zlib."""
    two = [Item("b/a", b"second\n"), Item("a", b"first\n")]
    digest = pack([*two, checksums(two)], tmp_path / "a.zip", folder="course", seconds=WHEN)
    assert digest == "da0541de75353b3c80422948db9c160cad929170f67e5d382343f2d1e037def4"
    smaller = pack([Item("a", b"x" * 9999)], tmp_path / "b.zip", folder="course", seconds=WHEN, compress=True)
    assert smaller and (tmp_path / "b.zip").stat().st_size < 500


def test_checksums_are_those_of_sha256sum(unpacked: Path) -> None:
    lines = (unpacked / CHECKSUMS).read_text(encoding="utf-8").splitlines()
    files = {
        p.relative_to(unpacked).as_posix() for p in unpacked.rglob("*") if p.is_file() and "__pycache__" not in p.parts
    }
    listed = dict(reversed(line.split("  ", 1)) for line in lines)
    assert set(listed) <= files and len(listed) == len(lines) > 700
    for name in ("README.md", "course/00_welcome.ipynb", "src/robotbrain/cli.py"):
        assert listed[name] == hashlib.sha256((unpacked / name).read_bytes()).hexdigest()


def test_where_the_time_comes_from() -> None:
    assert entry_time("", None) == WHEN and entry_time("", 5) == 5 and entry_time("7", 5) == 7
    with pytest.raises(InputError, match="SOURCE_DATE_EPOCH"):
        entry_time("yesterday", 5)


# ---------------------------------------------------------------- what is refused


@pytest.fixture
def small(template: Path, tmp_path: Path) -> Course:
    home = shutil.copytree(template, tmp_path / "small")
    return Course(home, home)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A course of one lab and one hidden test, under version control."""
    home = tmp_path_factory.mktemp("template") / "course"
    cell = nbformat.v4.new_code_cell("### BEGIN SOLUTION\nanswer = 6 * 7\n### END SOLUTION", id="answer")
    cell.metadata["nbgrader"] = {
        "grade": False, "grade_id": "answer", "locked": False, "schema_version": 3, "solution": True, "task": False
    }  # fmt: skip
    solved = nbformat.v4.new_notebook(cells=[cell])
    (home / "solutions" / "one").mkdir(parents=True)
    nbformat.write(solved, home / "solutions" / "one" / "one.ipynb")
    for name, text in {
        "course/00_welcome.ipynb": nbformat.writes(nbformat.v4.new_notebook()),
        "src/robotbrain/__init__.py": '"""Nothing."""\n',
        "autograder/profiles/one.toml": "a = 1\n",
        "autograder/nbgrader_config.py": (find_course(Path(__file__)).autograder / "nbgrader_config.py").read_text(),
        "autograder/hidden/one.py": HIDDEN,
        "pyproject.toml": "[project]\n",
        "constraints.txt": "",
        "environment.yml": "",
        "LICENSE": "Free.\n",
    }.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(text, encoding="utf-8")
    made = Course(home, home)
    generate(made, "one")
    (home / "autograder" / "gradebook.db").unlink()
    environment = os.environ | {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_AUTHOR_DATE": "@1700000000 +0000"}
    environment |= {"GIT_COMMITTER_DATE": "@1700000000 +0000"}
    for command in (["init", "-q"], ["add", "."], ["-c", "user.name=t", "-c", "user.email=t@x", "commit", "-qm", "m"]):
        subprocess.run(["git", *command], cwd=home, env=environment, check=True)
    return home


HIDDEN = """
def hidden_test(student):
    for amount, expected in ((1, 2), (20, 40), (33, 66)):
        given = student.answer(amount)
        assert given == expected, f"a hidden message about {amount}: {given} instead of {expected}"
"""


def test_the_command_writes_a_bundle_or_nothing(
    small: Course, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    command = ["bundle", "--course", str(small.home), "--out", str(tmp_path / "out.zip")]
    assert main(command) == 0
    said = capsys.readouterr().out
    first = (tmp_path / "out.zip").read_bytes()
    assert hashlib.sha256(first).hexdigest() in said and f"{len(first):,} bytes" in said
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        assert archive.infolist()[0].date_time == (2023, 11, 14, 22, 13, 20)
        assert b"answer = 6 * 7" not in archive.read(f"{FOLDER}/labs/one/one.ipynb")
    for path in small.home.rglob("*"):
        os.utime(path, (0, 0))
        path.chmod(0o700)
    monkeypatch.setattr("robotbrain.bundle.contents.check_labs", lambda course: None)  # they take seconds
    assert main(command) == 0 and (tmp_path / "out.zip").read_bytes() == first
    assert main([*command, "--list"]) == 0 and "labs/one/one.ipynb" in capsys.readouterr().out
    # The key in a lesson: the old file stays.
    lesson = small.home / "course" / "00_welcome.ipynb"
    cells = [nbformat.v4.new_markdown_cell(HIDDEN, id="x")]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), lesson)
    assert main(command) == 1 and (tmp_path / "out.zip").read_bytes() == first
    assert "course/00_welcome.ipynb holds 100% of autograder/hidden/one.py" in capsys.readouterr().err


def test_a_dirty_lab_is_refused(small: Course, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    released = small.home / "labs" / "one" / "one.ipynb"
    good = released.read_text(encoding="utf-8")
    released.write_text(good.replace("YOUR CODE", "SOME CODE"), encoding="utf-8")
    (small.home / "labs" / "two").mkdir()
    with pytest.raises(InputError, match=r"labs/two has no source.*one\.ipynb differs.*robotbrain generate"):
        check_labs(small)
    shutil.rmtree(small.home / "solutions")
    assert main(["bundle", "--course", str(small.home), "--out", str(tmp_path / "a.zip")]) == 2
    assert "labs/" in capsys.readouterr().err and not (tmp_path / "a.zip").exists()


def test_unknown_files_and_links_are_refused(small: Course, tmp_path: Path) -> None:
    def refused(path: str, match: str, link_to: Path | None = None) -> None:
        target = small.home / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(link_to) if link_to else target.write_text("x", encoding="utf-8")
        with pytest.raises(InputError, match=match):
            collect(small, tracked=tracked_files(small.home))
        target.unlink()

    assert collect(small, tracked=tracked_files(small.home)) == collect(small)
    refused("course/notes.txt", r"course/notes\.txt")  # a kind that no rule names
    refused("src/robotbrain/new.py", r"src/robotbrain/new\.py")  # not under version control
    refused("course/.hidden.md", r"\.hidden\.md")
    for place, target in (("course/a.md", small.home / "autograder" / "hidden" / "one.py"), ("labs/one/x", tmp_path)):
        refused(place, "a link", target)
    for name in ("course/CON.md", "course/Ä.md", f"course/{'long' * 40}.md"):
        (small.home / name).write_text("x", encoding="utf-8")
        with pytest.raises(InputError, match="Rename"):
            collect(small)
        (small.home / name).unlink()
    cache = small.home / "src" / "robotbrain" / "__pycache__"
    cache.mkdir()
    (cache / "x.pyc").write_bytes(b"x")
    (small.home / "course" / "00_welcome.ipynb").write_bytes(b'{\r\n "cells": []}\r\n')
    found = {item.name: item.data for item in collect(small)}
    assert not any("pyc" in name for name in found) and found["course/00_welcome.ipynb"] == b'{\n "cells": []}\n'
    (small.home / "LICENSE").unlink()
    with pytest.raises(InputError, match="Restore"):
        collect(small)


def test_without_version_control_the_rules_decide(tmp_path: Path) -> None:
    assert tracked_files(tmp_path) is None and last_change(tmp_path) is None


# ---------------------------------------------------------------- the other ways to give the library away


def test_packages_carry_no_key(repo: Path, key: Key, items: list[Item], tmp_path: Path) -> None:
    """A wheel holds the bundle's library; a source distribution would hold everything if nobody said what."""
    targets = tomllib.loads((repo / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    assert set(targets) == {"wheel", "sdist"}
    assert targets["wheel"]["packages"] == ["src/robotbrain"]
    assert set(targets["sdist"]["only-include"]) <= {"src/robotbrain", "autograder/profiles", "README.md", "LICENSE"}
    need(find_spec("hatchling"), "hatchling, which builds the packages, is not installed")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-t", "sdist", "-d", str(tmp_path)]
    subprocess.run(build, cwd=repo, check=True, capture_output=True)
    given = {item.name for item in items}
    for path in tmp_path.iterdir():
        if path.suffix == ".whl":
            with zipfile.ZipFile(path) as archive:
                inside = [Item(f"src/{n}", archive.read(n)) for n in archive.namelist()]
            library = {i.name.replace("src/robotbrain/jetson/data", "autograder/profiles") for i in inside}
            assert {n for n in given if n.startswith(("src/", "autograder/"))} <= library
        else:
            import tarfile

            with tarfile.open(path) as archive:
                files = [m for m in archive.getmembers() if m.isfile()]
                inside = [Item(m.name.partition("/")[2], archive.extractfile(m).read()) for m in files]
            names = {i.name for i in inside}
            assert not [n for n in names if n.startswith(("solutions", "tests"))]
            assert all(n.startswith("autograder/profiles/") for n in names if n.startswith("autograder/"))
        assert not [str(leak) for leak in key.leaks(inside)]
