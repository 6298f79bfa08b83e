"""What a copier does so that a copy does not look like one."""

from __future__ import annotations

import ast
import builtins
import random

_COMMENTS = ("# first we prepare the data", "# loop over everything", "# this is the tricky part", "# done")


def disguise(cells: list[str], seed: int = 0) -> list[str]:
    """The same program with other names, comments and layout, functions in another order, and cells cut in two."""
    rng = random.Random(seed)
    disguised: list[str] = []
    for source in cells:
        try:
            tree = ast.parse(source)
        except SyntaxError:
            disguised.append(source)
            continue
        tree = ast.fix_missing_locations(_Renamed(rng, _own_names(tree)).visit(tree))
        definitions = [n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
        rest = [n for n in tree.body if n not in definitions]
        rng.shuffle(definitions)
        pieces = [_commented(ast.unparse(ast.Module([node], [])), rng) for node in [*rest, *definitions]]
        cut = rng.randrange(1, len(pieces)) if len(pieces) > 1 else len(pieces)
        disguised += ["\n\n\n".join(part) for part in (pieces[:cut], pieces[cut:]) if part]
    return disguised


def _own_names(tree: ast.Module) -> set[str]:
    """Names the program chose itself: arguments and variables, but not what it imports or is asked to define."""
    stored = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    return (stored | {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}) - set(dir(builtins)) - {"self"}


class _Renamed(ast.NodeTransformer):
    def __init__(self, rng: random.Random, names: set[str]) -> None:
        fresh = [f"tmp_{i}" for i in range(len(names))]
        rng.shuffle(fresh)
        self.fresh = dict(zip(sorted(names), fresh, strict=True))

    def visit_Name(self, node: ast.Name) -> ast.Name:
        node.id = self.fresh.get(node.id, node.id)
        return node

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.arg = self.fresh.get(node.arg, node.arg)
        node.annotation = ast.Name("object", ast.Load())
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        if isinstance(node.value, float):
            node.value = node.value + 0.001
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self.generic_visit(node)
        if ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
        else:
            node.body.insert(0, ast.Expr(ast.Constant("Written all by myself.")))
        return node


def _commented(source: str, rng: random.Random) -> str:
    lines: list[str] = []
    for line in source.splitlines():
        if rng.random() < 0.3 and line.strip():
            lines.append(line[: len(line) - len(line.lstrip())] + rng.choice(_COMMENTS))
        lines.append(line + ("  # ok" if rng.random() < 0.2 and '"""' not in line and "'''" not in line else ""))
    return "\n".join(lines)
