"""Measures the structure of the source: modules, circles, sizes of functions, undocumented constants.

    python benchmarks/scale/structure.py            the table for this checkout
    python benchmarks/scale/structure.py --json     the same as one JSON object
    python benchmarks/scale/structure.py --root X   another checkout, to compare before and after

Imports are counted wherever they are: at the top, under `TYPE_CHECKING` and inside functions. A circle is a strongly
connected component of that graph (Tarjan, SIAM J. Comput. 1, 1972) with more than one module.
"""

from __future__ import annotations

import argparse
import ast
import functools
import json
import statistics
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

PACKAGES = {
    "autotuner": "autotuner",
    "autotuner_drivers": "drivers/autotuner_drivers",
    "autotuner_sim": "sim/autotuner_sim",
    "autotuner_models": "models/autotuner_models",
}


def sources(root: Path) -> dict[str, ast.Module]:
    """Return the syntax tree of every module by its dotted name."""
    found = {}
    for package, folder in PACKAGES.items():
        base = root / folder
        for path in sorted(base.rglob("*.py")):
            parts = [package, *path.relative_to(base).with_suffix("").parts]
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = parsed(path)
    return found


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a module; each is parsed once."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Return the modules of ours that each module imports, wherever the import is."""
    return {
        name: {one for node in ast.walk(tree) for one in _imported(node, trees)} - {name}
        for name, tree in trees.items()
    }


def _imported(node: ast.AST, known: dict[str, ast.Module]) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names if alias.name in known]
    if isinstance(node, ast.ImportFrom) and node.module:
        names = [f"{node.module}.{alias.name}" for alias in node.names]
        modules = [name for name in names if name in known]
        return modules + ([node.module] if node.module in known and len(modules) < len(names) else [])
    return []


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components with more than one module."""
    names = np.array(sorted(graph))
    edges = np.array([[other in graph[name] for other in names] for name in names])
    _, component = connected_components(edges, connection="strong")
    sizes = np.bincount(component)
    return [names[component == k].tolist() for k in np.flatnonzero(sizes > 1)]


def undocumented_constants(tree: ast.Module) -> list[str]:
    """Return the numeric constants of a module that no docstring follows."""
    pairs = zip(tree.body, [*tree.body[1:], None], strict=True)
    return [_constant(node) for node, after in pairs if _constant(node) and not _is_text(after)]


def _constant(node: ast.stmt) -> str:
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        name, value = node.targets[0].id, node.value
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
        name, value = node.target.id, node.value
    else:
        return ""
    numeric = any(isinstance(one, ast.Constant) and type(one.value) in {int, float} for one in ast.walk(value))
    plain = all(
        isinstance(one, ast.Constant | ast.UnaryOp | ast.BinOp | ast.operator | ast.unaryop) for one in ast.walk(value)
    )
    return name if numeric and plain and name.isupper() else ""


def _is_text(node: ast.stmt | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def measure(root: Path) -> dict[str, object]:
    """Return every figure of one checkout."""
    trees = sources(root)
    graph = imports(trees)
    importers = Counter(one for targets in graph.values() for one in targets)
    functions = [
        node
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    lengths = sorted((node.end_lineno or 0) - node.lineno + 1 for node in functions)
    inside = {id(one) for node in functions for one in ast.walk(node) if isinstance(one, ast.Import | ast.ImportFrom)}
    folders = Counter(name.rpartition(".")[0] for name in trees)
    return {
        "modules": len(trees),
        "modules with one importer": sum(importers[name] == 1 for name in trees),
        "import circles": len(circles(graph)),
        "modules in circles": sum(map(len, circles(graph))),
        "lines": sum(_lines(root, folder) for folder in PACKAGES.values()),
        "lines by package": {name: _lines(root, folder) for name, folder in PACKAGES.items()},
        "functions": len(lengths),
        "median lines of a function": statistics.median(lengths),
        "90th percentile": lengths[int(0.9 * len(lengths))],
        "functions over 40 lines": sum(length > 40 for length in lengths),
        "numeric constants without docstring": sum(len(undocumented_constants(tree)) for tree in trees.values()),
        "imports inside functions": len(inside),
        "largest folders": dict(folders.most_common(5)),
    }


def _lines(root: Path, folder: str) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in (root / folder).rglob("*.py"))


def main() -> None:
    """Print the figures of a checkout."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[2])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--circles", action="store_true", help="name the modules of each circle")
    chosen = parser.parse_args()
    figures = measure(chosen.root)
    if chosen.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:<38} {value}")
    for circle in circles(imports(sources(chosen.root))) if chosen.circles else []:
        print("circle:", ", ".join(circle))


if __name__ == "__main__":
    main()
