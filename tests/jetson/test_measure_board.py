"""Which module a board is, from device trees that people published, and the command line for its trtexec."""

from __future__ import annotations

from pathlib import Path

import pytest

from robotbrain.errors import InputError
from robotbrain.jetson.catalogue import list_modules
from robotbrain.jetson.measure.board import BY_MEMORY, MODULES, SUPER, Board, not_a_jetson, read_board, require_slug
from robotbrain.jetson.measure.command import Capabilities, Request, build_command, parse_shapes

LOGS = Path(__file__).resolve().parents[1] / "data" / "jetson_logs"


def plant(root: Path, compatible: str, **files: str) -> Path:
    """Make the files of a board below ``root``."""
    tree = root / "proc" / "device-tree"
    (tree / "chosen").mkdir(parents=True)
    (root / "etc").mkdir()
    (tree / "compatible").write_bytes(compatible.encode())
    for name, text in files.items():
        path = {"model": tree / "model", "ids": tree / "chosen" / "ids", "release": root / "etc" / "nv_tegra_release",
                "modes": root / "etc" / "nvpmodel.conf", "memory": root / "proc" / "meminfo"}[name]  # fmt: skip
        path.write_bytes(text.encode())
    return root


JP5_NANO = "nvidia,p3768-0000+p3767-0003\0nvidia,p3768-0000+p3767-0005\0nvidia,p3767-0003\0nvidia,tegra234\0"
SUPER_NANO = "nvidia,p3768-0000+p3767-0005-super\0nvidia,p3767-0005\0nvidia,tegra234\0"


@pytest.mark.parametrize(
    ("compatible", "files", "slug"),
    [
        (JP5_NANO, {"model": "NVIDIA Orin Nano Developer Kit\0"}, "orin-nano-8gb"),
        (SUPER_NANO, {"model": "NVIDIA Jetson Orin Nano Engineering Reference Developer Kit Super\0"},
         "orin-nano-8gb-super"),
        # an Orin Nano 4 GB on an Orin NX reference kit: the model names the kit
        ("nvidia,p3768-0000+p3767-0004\0nvidia,p3767-0004\0nvidia,tegra234\0",
         {"model": "NVIDIA Jetson Orin NX Engineering Reference Developer Kit\0"}, "orin-nano-4gb"),
        ("nvidia,p3768-0000+p3767-0000\0nvidia,p3767-0000\0nvidia,tegra234\0",
         {"ids": "3767-0000-301 3768-0000-ES1\0"}, "orin-nx-16gb"),
        ("nvidia,p3768-0000+p3767-0001\0nvidia,tegra234\0",
         {"modes": "< POWER_MODEL ID=0 NAME=MAXN_SUPER >\n"}, "orin-nx-8gb-super"),
        ("nvidia,p3737-0000+p3701-0005\0nvidia,p3701-0005\0nvidia,tegra234\0nvidia,tegra23x\0", {}, "agx-orin-64gb"),
        ("nvidia,p3737-0000+p3701-0004\0nvidia,tegra234\0", {}, "agx-orin-32gb"),
        # the device tree is that of a sibling, the boot loader's id is the module's
        ("nvidia,p3737-0000+p3701-0000\0nvidia,tegra234\0", {"ids": "3701-0004-500-J.0 3737-0000-TS4\0"},
         "agx-orin-32gb"),
        ("nvidia,p4071-0000+p3834-0008\0nvidia,p3834-0008\0nvidia,tegra264\0", {}, "t5000"),
        ("nvidia,p4071-0000+p3834-0000\0nvidia,tegra264\0", {}, "t4000"),
        ("nvidia,p3449-0000-b00+p3448-0000-b00\0nvidia,jetson-nano\0nvidia,tegra210\0",
         {"model": "NVIDIA Jetson Nano Developer Kit\0"}, "nano-4gb"),
        ("nvidia,p3542-0000+p3448-0003\0nvidia,jetson-nano\0nvidia,tegra210\0", {}, None),  # Nano 2GB
        ("nvidia,p2597-0000+p3310-1000\0nvidia,quill\0nvidia,tegra186\0", {}, "tx2"),
        ("nvidia,p3509-0000+p3668-0000\0nvidia,p3449-0000+p3668-0000\0nvidia,tegra194\0", {}, "xavier-nx"),
        ("nvidia,p2972-0000+p2888-0001\0nvidia,tegra194\0", {"memory": "MemTotal:       32692908 kB\n"},
         "agx-xavier-32gb"),
        ("nvidia,p2972-0000+p2888-0001\0nvidia,tegra194\0", {"memory": "MemTotal:       16692908 kB\n"}, None),
        ("nvidia,tegra234\0", {}, None),
    ],
)  # fmt: skip
def test_the_module_of_a_board(tmp_path: Path, compatible: str, files: dict[str, str], slug: str | None) -> None:
    board = read_board(plant(tmp_path, compatible, **files))
    assert board.is_jetson
    assert board.slug == slug


def test_every_module_it_can_find_is_in_the_catalogue() -> None:
    known = {*MODULES.values(), *(slug for _, _, slug in BY_MEMORY.values()), *(f"{slug}-super" for slug in SUPER)}
    assert known == set(list_modules())


def test_versions_and_modes(tmp_path: Path) -> None:
    release = "# R36 (release), REVISION: 4.3, GCID: 38968081, BOARD: generic, EABI: aarch64, DATE: Wed Jan  8 2025\n"
    board = read_board(plant(tmp_path, SUPER_NANO, release=release, modes="< POWER_MODEL ID=1 NAME=25W >\n"))
    assert board.jetson_linux == "36.4.3"
    assert board.modes == {1: "25W"}


def test_this_machine_and_an_empty_one_are_read_without_error(tmp_path: Path) -> None:
    assert not read_board(tmp_path).is_jetson
    read_board()


@pytest.mark.parametrize("compatible", ["raspberrypi,4-model-b\0brcm,bcm2711\0", "nvidia,dgx\0", "\xff\0\0"])
def test_other_machines_are_no_jetson(tmp_path: Path, compatible: str) -> None:
    assert not read_board(plant(tmp_path, compatible)).is_jetson


def test_what_to_do_without_a_jetson() -> None:
    text = str(not_a_jetson(Board(machine="x86_64"), ["trtexec"]))
    for words in ("x86_64", "trtexec", "--from-logs", "copy", "pip install"):
        assert words.casefold() in text.casefold()


def test_a_named_device_must_not_contradict_the_board() -> None:
    nano = Board(compatible=tuple(JP5_NANO.split("\0")))
    assert require_slug(nano, None) == "orin-nano-8gb"
    assert require_slug(nano, "orin-nano-8gb-super") == "orin-nano-8gb-super"  # flashed, but the tree says nothing
    with pytest.raises(InputError, match="orin-nano-8gb"):
        require_slug(nano, "t5000")
    assert require_slug(Board(), "t5000") == "t5000"
    with pytest.raises(InputError, match="--device"):
        require_slug(Board(), None)


# ---- command line ----


def capabilities(name: str) -> Capabilities:
    return Capabilities.from_help((LOGS / name).read_text(encoding="utf-8"))


OLD = Capabilities(None, capabilities("trtexec_help_8_4.txt").options - {"memPoolSize"}, False)  # as TensorRT 7
NEWEST = Capabilities("11.1.0", capabilities("trtexec_help_10_5.txt").options - {"fp16", "int8", "stronglyTyped"}, True)


def test_capabilities() -> None:
    old, new = capabilities("trtexec_help_8_4.txt"), capabilities("trtexec_help_10_5.txt")
    assert (old.version, old.percentiles) == ("8.4.1", False)
    assert (new.version, new.percentiles) == ("10.5.0", True)
    assert "workspace" in old.options and "workspace" not in new.options
    assert "help" not in old.options  # the banner repeats the command line; it lists nothing


@pytest.mark.parametrize("text", ["", "usage: cat [--help]", "&&&& RUNNING TensorRT.trtexec # trtexec --onnx=a"])
def test_another_programs_help_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--help"):
        Capabilities.from_help(text)


@pytest.mark.parametrize("precision", ["fp32", "fp16", "int8"])
@pytest.mark.parametrize("which", ["trtexec_help_8_4.txt", "trtexec_help_10_5.txt", "old"])
@pytest.mark.parametrize("workspace", [None, 512])
def test_only_options_that_are_there_are_used(which: str, precision: str, workspace: int | None) -> None:
    able = OLD if which == "old" else capabilities(which)
    request = Request(
        "m.onnx", precision, {"x": (1, 3, 8, 8)}, workspace_mb=workspace, cuda_graph=True, save_engine="e"
    )
    words = build_command(["trtexec"], able, request)
    assert {word.partition("=")[0].removeprefix("--") for word in words[1:]} <= able.options
    assert ("--fp16" in words) == (precision != "fp32")
    assert ("--int8" in words) == (precision == "int8")
    assert "--shapes=x:1x3x8x8" in words and "--useCudaGraph" in words and "--noDataTransfers" in words
    assert ("--explicitBatch" in words) == (which == "old")


def test_the_workspace_is_named_as_the_version_names_it() -> None:
    request = Request("m.onnx", workspace_mb=512)
    assert "--memPoolSize=workspace:512" in build_command(["t"], capabilities("trtexec_help_10_5.txt"), request)
    assert "--workspace=512" in build_command(["t"], OLD, request)
    # 16 MiB, the default of these versions, would leave out the fast convolutions
    assert "--workspace=1024" in build_command(["t"], OLD, Request("m.onnx"))


def test_a_plain_run_launches_kernel_by_kernel() -> None:
    words = build_command(["t"], capabilities("trtexec_help_10_5.txt"), Request("m.onnx", data_transfers=True))
    assert not {"--useCudaGraph", "--noDataTransfers"} & set(words)


def test_strongly_typed_versions_refuse_a_precision_they_cannot_give() -> None:
    with pytest.raises(InputError, match="--typed"):
        build_command(["t"], NEWEST, Request("m.onnx", "fp16"))
    assert build_command(["t"], NEWEST, Request("m.onnx", "fp32"))
    assert build_command(["t"], NEWEST, Request("m.onnx", "fp16", typed=True))
    able = capabilities("trtexec_help_10_5.txt")
    assert "--stronglyTyped" in build_command(["t"], able, Request("m.onnx", "int8", typed=True))


def test_a_trtexec_without_an_option_it_needs_is_refused() -> None:
    poor = Capabilities("6.0.1", frozenset({"onnx", "fp16", "workspace"}), False)
    with pytest.raises(InputError, match="--from-logs"):
        build_command(["t"], poor, Request("m.onnx"))


def test_shapes() -> None:
    assert parse_shapes(["a:1x3x4", "b:2,c:5x6"]) == {"a": (1, 3, 4), "b": (2,), "c": (5, 6)}
    assert parse_shapes(["Input:0:1x2"]) == {"Input:0": (1, 2)}
    words = build_command(["t"], OLD, Request("m.onnx", shapes={"Input:0": (1, 2)}))
    assert "--shapes='Input:0':1x2" in words
    for wrong in ("a", "a:", ":1x2", "a:0x3", "a:1x", "a:-1x3", "a:1×3", ""):
        with pytest.raises(InputError, match="--shape"):
            parse_shapes([wrong])


@pytest.mark.parametrize("changes", [{"precision": "fp8"}, {"iterations": 0}, {"duration_s": -1}, {"warm_up_ms": -1}])
def test_requests_out_of_range_are_refused(changes: dict[str, int]) -> None:
    with pytest.raises(InputError):
        Request("m.onnx", **changes)  # type: ignore[arg-type]
