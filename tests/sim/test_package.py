"""The package's names, and what importing it costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

import robotbrain.sim as sim


def test_every_public_name_resolves_and_is_documented() -> None:
    assert set(sim.__all__) == set(sim._MODULE_OF)
    for name in sim.__all__:
        thing = getattr(sim, name)
        assert name.isupper() or thing.__doc__
    assert set(sim.__all__) <= set(dir(sim))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        sim.nothing  # noqa: B018


def test_import_loads_nothing_heavy() -> None:
    heavy = "{'mujoco', 'torch', 'meshcat', 'matplotlib', 'scipy', 'numpy'}"
    code = f"import sys, robotbrain.sim; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
    code = (
        "import sys; from robotbrain.sim import RobotSim, generate_world; RobotSim(generate_world(0));"
        "print(sorted({'torch', 'meshcat', 'matplotlib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
