"""Writes ``data/genuine_tf2.json.gz``: what genuine tf2 answers to random programs, as an oracle.

Not run by the tests. tf2 is not on PyPI, but its core is a few C++ files and its Python binding needs nothing else than
message structs, so that both build with a C++ compiler alone::

    git clone https://github.com/ros2/geometry2
    python tests/ros/make_tf2_fixture.py geometry2

The binding is built against the running Python and takes its messages and ``rclpy.time.Time`` from the kit.
"""

from __future__ import annotations

import gzip
import importlib
import importlib.util
import json
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

TARGET = Path(__file__).parent / "data" / "genuine_tf2.json.gz"
PROGRAMS = 30

# What the generated message headers and rcutils give to tf2, as far as it uses them.
HEADERS = {
    "builtin_interfaces/msg/time.hpp": """
        #pragma once
        #include <cstdint>
        namespace builtin_interfaces::msg { struct Time { int32_t sec = 0; uint32_t nanosec = 0; }; }
    """,
    "geometry_msgs/msg/transform.hpp": """
        #pragma once
        #include <cmath>
        #include <string>
        #include "builtin_interfaces/msg/time.hpp"
        namespace std_msgs::msg { struct Header { builtin_interfaces::msg::Time stamp; std::string frame_id; }; }
        namespace geometry_msgs::msg {
        struct Vector3 { double x = 0, y = 0, z = 0; };
        struct Quaternion { double x = 0, y = 0, z = 0, w = 1; };
        struct Transform { Vector3 translation; Quaternion rotation; };
        }
    """,
    "geometry_msgs/msg/transform_stamped.hpp": """
        #pragma once
        #include "geometry_msgs/msg/transform.hpp"
        namespace geometry_msgs::msg {
        struct TransformStamped { std_msgs::msg::Header header; std::string child_frame_id; Transform transform; };
        }
    """,
    "geometry_msgs/msg/velocity_stamped.hpp": """
        #pragma once
        #include "geometry_msgs/msg/transform.hpp"
        namespace geometry_msgs::msg {
        struct Twist { Vector3 linear, angular; };
        struct VelocityStamped {
          std_msgs::msg::Header header; std::string body_frame_id, reference_frame_id; Twist velocity;
        };
        }
    """,
    "rcutils/logging_macros.h": """
        #pragma once
        #define RCUTILS_STEADY_TIME 0
        #define RCUTILS_LOG_ERROR(...) ((void)0)
        #define RCUTILS_LOG_WARN(...) ((void)0)
        #define RCUTILS_LOG_WARN_THROTTLE(...) ((void)0)
    """,
    "rcutils/snprintf.h": """
        #pragma once
        #include <cstdio>
        #define rcutils_snprintf std::snprintf
    """,
    "rcutils/strerror.h": """
        #pragma once
        #include <cstddef>
        inline void rcutils_strerror(char * buffer, std::size_t size) { if (size) {buffer[0] = 0;} }
    """,
}


def build(checkout: Path, folder: Path):
    """Compile tf2's core and binding into ``folder``; return the extension module."""
    for name, text in HEADERS.items():
        path = folder / "include" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    library = folder / f"_tf2_py{sysconfig.get_config_var('EXT_SUFFIX')}"
    sources = [*sorted((checkout / "tf2" / "src").glob("*.cpp")), checkout / "tf2_py" / "src" / "tf2_py.cpp"]
    includes = [folder / "include", checkout / "tf2" / "include", sysconfig.get_paths()["include"]]
    command = ["g++", "-std=c++17", "-O2", "-shared", "-fPIC", "-w", "-o", str(library)]
    subprocess.run([*command, *(f"-I{path}" for path in includes), *map(str, sources)], check=True)
    spec = importlib.util.spec_from_file_location("_tf2_py", library)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    importlib.import_module("robotbrain.ros")  # makes rclpy and the interface packages importable
    from tf2_programs import corner_cases, random_program, run

    checkout = Path(sys.argv[1])
    version = subprocess.run(["git", "-C", str(checkout), "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    with tempfile.TemporaryDirectory() as folder:
        genuine = build(checkout, Path(folder))
        runs = []
        for program in [corner_cases(), *map(random_program, range(PROGRAMS))]:
            runs.append({"program": program, "answers": run(genuine.BufferCore(), program)})
    TARGET.write_bytes(gzip.compress(json.dumps({"geometry2": version.strip(), "runs": runs}).encode(), mtime=0))
    print(f"{sum(len(one['program']) for one in runs)} operations, {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
