"""The typing stub and the simulated runtime have the names of the genuine TensorRT bindings, version by version.

``python -m tests.conformance_tensorrt`` read them from the genuine bindings of 8.6.1, 10.3, 10.13, 11.0 and 11.4.
"""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import pytest
from tests.conformance_tensorrt.__main__ import NAMES, STUB, stub_classes

from robotbrain.jetson.engine import runtime
from robotbrain.jetson.engine.simulated import VERSIONS, simulated_runtime
from robotbrain.jetson.software import load_jetpacks

GENUINE: dict[str, dict[str, Any]] = json.loads(NAMES.read_text(encoding="utf-8"))


def names(version: str, kind: str) -> set[str]:
    found = GENUINE[version].get(kind, "")
    return set(found if isinstance(found, dict) else found.split())


def test_the_stub_has_nothing_that_no_version_has() -> None:
    for kind, members in stub_classes().items():
        known = {name for version in GENUINE for name in names(version, kind)}
        assert members <= known, (kind, members - known)
        assert any(kind in GENUINE[version] for version in GENUINE)


def test_the_stub_marks_what_only_some_versions_have() -> None:
    """Every class or member that some checked version lacks carries a comment that says so, and no other does."""
    lines = STUB.read_text(encoding="utf-8").splitlines()
    for node in ast.parse("\n".join(lines)).body:
        if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
            continue
        lacking = {version for version in GENUINE if node.name not in GENUINE[version]}
        assert bool(lacking) == ("# " in lines[node.lineno - 1]), node.name
        for part in node.body:
            name = getattr(part, "name", None) or getattr(getattr(part, "target", None), "id", "_")
            if not name.startswith("_") and not lacking:
                partly = any(name not in names(version, node.name) for version in GENUINE)
                assert partly == ("# " in lines[part.lineno - 1]), f"{node.name}.{name}"


@pytest.mark.parametrize("version", [version for version in VERSIONS if version in GENUINE])
def test_the_simulated_runtime_has_the_names_and_numbers_of_its_version(version: str) -> None:
    module = simulated_runtime(version).trt
    checked = 0
    for kind in stub_classes():
        simulated = getattr(module, kind, None)
        if kind != "Dims":  # plain tuples here
            assert (simulated is not None) == (kind in GENUINE[version]), kind
        if simulated is None:
            continue
        if hasattr(simulated, "__members__"):
            values = {name: int(value) for name, value in simulated.__members__.items()}
            assert values.items() <= GENUINE[version][kind].items(), kind
        else:
            inherited = set(dir(bytes)) if issubclass(simulated, bytes) else set()
            public = {name for name in dir(simulated) if not name.startswith("_")} - inherited
            assert public <= names(version, kind), (kind, public - names(version, kind))
        checked += 1
    assert checked >= 20


@pytest.mark.parametrize("version", [version for version in VERSIONS if version in GENUINE])
def test_the_simulated_runtime_lacks_what_its_version_lacks(version: str) -> None:
    """What differs between the versions and matters to the engine, both in the genuine names and in the stand-in."""
    module: Any = simulated_runtime(version).trt
    for kind, name in (
        ("NetworkDefinitionCreationFlag", "EXPLICIT_BATCH"),
        ("NetworkDefinitionCreationFlag", "STRONGLY_TYPED"),
        ("BuilderFlag", "FP16"),
        ("BuilderFlag", "INT8"),
        ("ICudaEngine", "num_bindings"),
        ("ICudaEngine", "get_binding_name"),
        ("IBuilderConfig", "progress_monitor"),
        ("ParserError", "node_name"),
        ("IExecutionContext", "execute_v2"),
        ("IExecutionContext", "execute_async_v3"),
    ):
        assert hasattr(getattr(module, kind), name) == (name in names(version, kind)), (kind, name)


def test_every_name_that_the_code_looks_up_is_in_the_stub() -> None:
    """``trt.X`` in the engine's sources is in ``TensorRTModule``, whose classes are the stub's."""
    folder = Path(runtime.__file__).parent
    protocol = set(runtime.TensorRTModule.__annotations__)
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "trt":
                assert node.attr in protocol, (path.name, node.attr)
    assert protocol - {"__version__"} <= set(stub_classes())


@pytest.mark.parametrize(
    "name", ["interface", "timing", "cuda", "plan", "build", "runtime", "tensorrt_engine", "opening", "__init__"]
)
def test_the_boards_modules_parse_as_python_3_8(name: str) -> None:
    """JetPack 5's TensorRT belongs to Python 3.8; annotations are strings there, so newer ones do no harm."""
    text = (Path(runtime.__file__).parent / f"{name}.py").read_text(encoding="utf-8")
    tree = ast.parse(text, feature_version=(3, 8))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    keywords = {
        (getattr(call.func, "id", getattr(call.func, "attr", "")), word.arg) for call in calls for word in call.keywords
    }
    newer = {("zip", "strict"), ("dataclass", "slots"), ("dataclass", "kw_only"), ("write_text", "newline")}
    assert not keywords & newer and "from __future__ import annotations" in text


def test_the_page_agrees_with_the_tables_and_the_tests() -> None:
    page = (Path(runtime.__file__).parent / "TENSORRT_TODAY.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    found = {row[0]: (row[1], row[2], row[3].startswith("yes")) for row in rows if row[0][:1].isdigit()}
    expected = {
        release.version: (
            release.tensorrt.text,
            release.python.text,
            tuple(map(int, release.tensorrt.text.split("."))) >= runtime.OLDEST,
        )
        for release in load_jetpacks()
    }
    assert found == expected
    wrong_engines = (Path(__file__).parent / "test_engine_tensorrt.py").read_text(encoding="utf-8")
    for name in ("SwapsHostAndDevice", "CopiesOutFirst", "NoSynchronise", "OverwritesInput", "HostAddresses"):
        assert name in page and f"class {name}(" in wrong_engines
