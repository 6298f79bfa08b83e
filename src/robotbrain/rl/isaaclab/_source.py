"""Copies of a task's own functions and classes, with what they need, as source that runs beside genuine Isaac Lab."""

from __future__ import annotations

import ast
import builtins
import inspect
import re
import sys
import textwrap
import types
from typing import Any

import torch

from robotbrain.errors import InputError

KIT = "robotbrain.rl"
OWN_TERMS = ("extra", "extra_actions", "extra_events", "_latency")
"""Modules of ``robotbrain.rl.mdp`` that Isaac Lab does not have; the others are its ``mdp`` under the same names."""
MDP = "isaaclab_tasks.core.velocity.mdp"
"""The genuine module with all terms: it passes on ``isaaclab.envs.mdp`` and adds those of walking robots."""

_IMPORTS = {  # names of the kit, and where genuine Isaac Lab has them
    f"{KIT}.managers": "isaaclab.managers",
    f"{KIT}.noise_cfg": "isaaclab.utils.noise",
    f"{KIT}.ppo_cfg": "isaaclab_rl.rsl_rl",
    f"{KIT}.math_utils": "isaaclab.utils.math",
}
_TYPES_ONLY = {"ManagerBasedRLEnv": "isaaclab.envs", "ManagerBasedEnv": "isaaclab.envs"}
_KIT_ONLY = re.compile(r"\.scene\.world\b|\.model_param\(|\.default_model_param\(|\.mark_const_dirty\(")
_INPUT_ERROR = '''class InputError(ValueError):
    """A parameter that cannot be used."""

    def __init__(self, what, *, given, expected, fix):
        super().__init__(f"{what}: got {given!r}; expected {expected}. {fix}")
'''
_LITERALS = (bool, int, float, str, bytes, type(None))


def is_genuine_term(thing: Any) -> bool:
    """Whether Isaac Lab's ``mdp`` has this function or class of the kit under the same name."""
    module = getattr(thing, "__module__", "")
    return module.startswith(f"{KIT}.mdp.") and module.rpartition(".")[2] not in OWN_TERMS


def genuine_module(thing: Any) -> str | None:
    """The genuine module that has this class of the kit under the same name, None for a class of the task's own."""
    module = getattr(thing, "__module__", "")
    return next((new for old, new in _IMPORTS.items() if module == old or module.startswith(old + ".")), None)


class Sources:
    """Collects imports and copied definitions, each after those it needs."""

    def __init__(self) -> None:
        self.imports: set[str] = set()
        self.type_imports: set[str] = set()
        self.definitions: dict[str, str] = {}
        self._owners: dict[str, str] = {}

    def reference(self, thing: Any, where: str) -> str:
        """How to name a function or class in the generated file; what is the task's own is copied into it.

        Raises:
            InputError: there is no source to copy, or it cannot stand alone.
        """
        if is_genuine_term(thing):
            self.imports.add(f"import {MDP} as mdp")
            return f"mdp.{thing.__qualname__}"
        module = genuine_module(thing)
        if module is not None:
            self.imports.add(f"from {module} import {thing.__qualname__.partition('.')[0]}")
            return str(thing.__qualname__)
        self._copy(thing, where)
        return str(thing.__name__)

    def _copy(self, thing: Any, where: str) -> None:
        name, qualname = getattr(thing, "__name__", "?"), getattr(thing, "__qualname__", "?")
        if name == "<lambda>" or "<locals>" in qualname or "." in qualname or getattr(thing, "__closure__", None):
            raise InputError(
                where,
                given=qualname,
                expected="a function or class defined by name at the top of a module",
                fix="Write `def my_term(env): ...` at the top level; lambdas and inner functions have no source of "
                "their own.",
            )
        source = _source(thing, where)
        inside = _KIT_ONLY.search(source)
        if inside is not None:
            raise InputError(
                where,
                given=f"{name} uses {inside.group().strip('.(')}",
                expected="terms that read env.scene[...].data, sensors, commands and actions only",
                fix="Isaac Lab has no such access to the simulation: write this term with what both have, or leave it "
                "out of the exported task.",
            )
        tree = ast.parse(source)
        if name in self.definitions:
            if self._marker(thing) != self._owners[name]:
                raise InputError(
                    where, given=name, expected="different names for different things", fix="Rename one of the two."
                )
            return
        self.definitions[name] = ""  # so that what refers back to it does not copy it again
        self._owners[name] = self._marker(thing)
        names, hinted = _names(tree)
        scope = _scope(thing)
        for used in sorted(names - {name}):
            if used in scope:
                source = self._need(used, scope[used], source, where)
            elif not hasattr(builtins, used):
                raise InputError(
                    where, given=used, expected="names that its module defines", fix=f"{name} uses {used!r}: define it."
                )
        for used in sorted(hinted - names):
            if used in _TYPES_ONLY:
                self.type_imports.add(f"from {_TYPES_ONLY[used]} import {used}")
            elif used in scope and used != name:
                self._hint(used, scope[used])
        del self.definitions[name]
        self.definitions[name] = source

    @staticmethod
    def _marker(thing: Any) -> str:
        return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', thing)!s}"

    def _need(self, used: str, value: Any, source: str, where: str) -> str:
        """Make ``used`` mean ``value`` in the generated file; returns the source, changed where names differ."""
        if isinstance(value, types.ModuleType):
            return self._need_module(used, value, source, where)
        module = getattr(value, "__module__", None)
        top = (module or "").partition(".")[0]
        if isinstance(value, torch.Tensor):
            self.imports.add("import torch")
            self.definitions.setdefault(used, f"{used} = torch.tensor({value.tolist()!r}, dtype={value.dtype})")
        elif isinstance(value, _LITERALS) or _is_plain(value):
            self.definitions.setdefault(used, f"{used} = {value!r}")
        elif f"{module}" == "dataclasses" or str(value) == "<dataclasses._MISSING_TYPE object>" or used == "MISSING":
            self.imports.add("from dataclasses import MISSING")
        elif used == "configclass":
            self.imports.add("from isaaclab.utils import configclass")
        elif used == "Config":
            return re.sub(r"\(Config\)", "", source)
        elif value is InputError:
            self.definitions.setdefault("InputError", _INPUT_ERROR)
        elif top == "robotbrain" and not (module or "").startswith((f"{KIT}.mdp", f"{KIT}.tasks")):
            genuine = genuine_module(value)
            if genuine is None:
                raise InputError(
                    where,
                    given=f"{used} of {module}",
                    expected="things that Isaac Lab has too",
                    fix="Use torch, the functions of isaaclab.utils.math (here robotbrain.rl.math_utils) and the "
                    "environment's own data.",
                )
            self.imports.add(f"from {genuine} import {used}")
        elif is_genuine_term(value):
            self.imports.add(f"import {MDP} as mdp")
            return re.sub(rf"(?<![\w.]){re.escape(used)}(?=\s*[\(.,\)\]:\n])", f"mdp.{value.__qualname__}", source)
        elif top == "torch" or top in sys.stdlib_module_names or _is_installed(module):
            self.imports.add(f"from {module} import {getattr(value, '__name__', used)}" + _alias(value, used))
        else:
            self._copy(value, where)
        return source

    def _need_module(self, used: str, value: types.ModuleType, source: str, where: str) -> str:
        if value.__name__ == f"{KIT}.mdp":
            for attribute in sorted(set(re.findall(rf"\b{used}\.(\w+)", source))):
                term = getattr(value, attribute, None)
                if term is None or is_genuine_term(term):
                    self.imports.add(f"import {MDP} as mdp")
                    source = re.sub(rf"\b{used}\.{attribute}\b", f"mdp.{attribute}", source)
                else:
                    source = re.sub(rf"\b{used}\.{attribute}\b", self.reference(term, where), source)
            return source
        name = _IMPORTS.get(value.__name__, value.__name__)
        if name.startswith("robotbrain"):
            raise InputError(
                where, given=name, expected="modules that Isaac Lab has too", fix="Import the names you need instead."
            )
        plain = name == used
        self.imports.add(f"import {name}" if plain else f"import {name} as {used}")
        return source

    def _hint(self, used: str, value: Any) -> None:
        module = getattr(value, "__module__", None)
        if isinstance(value, types.ModuleType):
            self.imports.add(f"import {value.__name__}" + ("" if value.__name__ == used else f" as {used}"))
        elif module == "typing" or used in ("Any", "Literal", "ClassVar"):
            self.imports.add(f"from typing import {used}")
        elif module in sys.stdlib_module_names:
            self.type_imports.add(f"from {module} import {used}")
        elif module is not None and module.startswith("torch"):
            self.imports.add("import torch")
            if used == "Tensor":
                self.definitions.setdefault(used, "Tensor = torch.Tensor")
        elif genuine_module(value) is not None:
            self.imports.add(f"from {genuine_module(value)} import {used}")
        elif used in self.definitions:
            return
        elif _is_plain(value) or isinstance(value, types.GenericAlias | types.UnionType):
            self.definitions.setdefault(used, f"{used} = {value!r}")


def _source(thing: Any, where: str) -> str:
    try:
        return textwrap.dedent(inspect.getsource(thing)).rstrip() + "\n"
    except (OSError, TypeError) as error:
        raise InputError(
            where,
            given=getattr(thing, "__qualname__", thing),
            expected="something whose source Python can find",
            fix="Put it into a .py file (or a notebook cell that was run in this session) instead of typing it into a "
            f"prompt or making it with exec. Python says: {error}.",
        ) from error


def _scope(thing: Any) -> dict[str, Any]:
    found = getattr(thing, "__globals__", None)
    return dict(found if found is not None else vars(sys.modules[thing.__module__]))


def _names(tree: ast.AST) -> tuple[set[str], set[str]]:
    """Free names that a definition uses when it runs, and those that its annotations alone use."""
    run: set[str] = set()
    hints: set[str] = set()
    bound: set[str] = set()

    def visit(node: ast.AST, hint: bool) -> None:
        if isinstance(node, ast.Name):
            (bound if isinstance(node.ctx, ast.Store) else hints if hint else run).add(node.id)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
            if node.annotation is not None:
                visit(node.annotation, True)
            return
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            bound.add(node.name)
        for field, value in ast.iter_fields(node):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    visit(child, hint or field in ("annotation", "returns"))

    visit(tree, False)
    return run - bound, hints - bound


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list | set | frozenset):
        return all(_is_plain(item) for item in value)
    if isinstance(value, dict):
        return all(_is_plain(k) and _is_plain(v) for k, v in value.items())
    return isinstance(value, _LITERALS)


def _is_installed(module: str | None) -> bool:
    found = sys.modules.get(module or "")
    path = getattr(found, "__file__", None)
    return found is not None and (path is None or "site-packages" in path or "dist-packages" in path)


def _alias(value: Any, used: str) -> str:
    name = getattr(value, "__name__", used)
    return "" if name == used else f" as {used}"
