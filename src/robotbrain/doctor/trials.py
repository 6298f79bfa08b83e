"""The process that :mod:`robotbrain.doctor.isolated` starts: one JSON line when a trial begins, one when it ends.

``import:NAME`` imports a module; the other trials are functions below.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from typing import Any, TextIO

# y = x + x for two numbers, as ONNX: made once by onnx.helper, so that this needs only ONNX Runtime.
_TINY_ONNX = bytes.fromhex(
    "08083a350a0e0a01780a017812017922034164641201675a0f0a0178120a0a08080112040a020802620f0a0179120a0a08080112040a020802"
    "42040a00100d"
)
_TINY_WORLD = (
    "<mujoco><worldbody><body pos='0 0 1'><freejoint/><geom type='sphere' size='.1' mass='1'/></body>"
    "</worldbody></mujoco>"
)


def compute_torch() -> dict[str, Any]:
    """Multiply with torch; say what it was built for."""
    import torch

    product = (torch.full((4, 4), 2.0) @ torch.eye(4)).sum().item()
    if product != 32.0:
        raise ArithmeticError(f"torch multiplied wrongly: {product} instead of 32")
    cuda = torch.cuda.is_available() if torch.version.cuda else False
    return {"version": torch.__version__, "cuda_build": torch.version.cuda, "cuda": cuda}


def compute_onnxruntime() -> dict[str, Any]:
    """Run a tiny network with ONNX Runtime."""
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(_TINY_ONNX, options, providers=["CPUExecutionProvider"])
    answer = session.run(None, {"x": np.array([1.0, 2.0], np.float32)})[0].tolist()
    if answer != [2.0, 4.0]:
        raise ArithmeticError(f"ONNX Runtime added wrongly: {answer} instead of [2, 4]")
    return {"providers": onnxruntime.get_available_providers()}


def compute_mujoco() -> dict[str, Any]:
    """Let a ball fall in MuJoCo, alone and in a batch."""
    import mujoco
    import mujoco.batch

    model = mujoco.MjModel.from_xml_string(_TINY_WORLD)
    data = mujoco.MjData(model)
    for _ in range(50):
        mujoco.mj_step(model, data)
    fallen = 1.0 - float(data.qpos[2])
    if not 0.03 < fallen < 0.07:  # g t^2 / 2 after 0.1 s is 0.049 m
        raise ArithmeticError(f"in 0.1 s a ball fell {fallen} m instead of 0.05 m")
    return {"version": mujoco.__version__}


def sandbox_layers() -> dict[str, Any]:
    """Start a student's process and say what shuts it in."""
    from robotbrain.grading.bench import host_layers

    return {"layers": [[layer.name, layer.active, layer.note] for layer in host_layers()]}


def load_nbgrader_config(path: str) -> dict[str, Any]:
    """Load an instructor's ``nbgrader_config.py`` as nbgrader does; say where it puts things."""
    from pathlib import Path

    from traitlets.config import PyFileConfigLoader

    config = PyFileConfigLoader(Path(path).name, str(Path(path).parent)).load_config()
    section = config.CourseDirectory
    return {"db_url": section.get("db_url", ""), "root": section.get("root", "")}


def exchange_place() -> dict[str, Any]:
    """Say where the kit takes nbgrader's exchange to be, and what speaks against using it."""
    from robotbrain.exchange import find_exchange

    place = find_exchange()
    problem = ""
    if not place.own:  # one's own is made when it is first used
        if not place.path.is_dir():
            problem = "does not exist"
        elif not os.access(place.path, os.W_OK | os.X_OK):
            problem = "cannot be written to"
        elif place.path.stat().st_mode & 0o007 != 0o007:
            problem = "is not open to all users, as nbgrader wants it"
    return {"path": str(place.path), "why": place.why, "problem": problem}


TRIALS: dict[str, Callable[..., dict[str, Any]]] = {
    "torch": compute_torch,
    "onnxruntime": compute_onnxruntime,
    "mujoco": compute_mujoco,
    "sandbox": sandbox_layers,
    "nbgrader-config": load_nbgrader_config,
    "exchange": exchange_place,
}


def _try(trial: str) -> dict[str, Any]:
    kind, _, argument = trial.partition(":")
    if kind == "import":
        importlib.import_module(argument)
        return {"file": getattr(sys.modules[argument], "__file__", None)}
    return TRIALS[kind](argument) if argument else TRIALS[kind]()


def _say(stream: TextIO, **words: Any) -> None:
    stream.write(json.dumps(words) + "\n")
    stream.flush()


def main(trials: list[str]) -> None:
    """Make the trials and report on the standard output, which nothing else gets to write to."""
    sys.stdout.flush()
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8", newline="\n")
    os.dup2(2, 1)
    for trial in trials:
        _say(stream, trial=trial, state="begun")
        try:
            data = _try(trial)
        except BaseException as error:  # SystemExit included: a module may call sys.exit when it is imported
            first = str(error).strip().partition("\n")[0]
            _say(stream, trial=trial, state="raised", message=f"{type(error).__name__}: {first}"[:500])
        else:
            _say(stream, trial=trial, state="done", data=data)
    stream.close()
    # Native libraries may crash or wait for threads while the interpreter shuts down; nobody needs that here.
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
