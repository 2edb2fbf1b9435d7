"""Who imports whom, what the core may touch, and how long functions are."""

import ast
import importlib.util
import statistics

import pytest

PURE = {
    "__future__", "abc", "bisect", "cmath", "collections", "csv", "dataclasses", "datetime", "enum", "functools", "io",
    "itertools", "math", "numbers", "numpy", "operator", "re", "scipy", "types", "typing",
}  # fmt: skip
"""What the core may import beside itself and `autotuner.errors`.

`csv`, `io` and `datetime` work on text that was read elsewhere; the linter bans `datetime.now`."""

READS_A_FILE = ("recording.py", "pathlib")
"""`Recording.from_csv`: the one place where the core opens a file."""

LAZY_IMPORTS = ("lazy_imports.py", "importlib")
"""Names of a package whose module is imported when they are first asked for: the one place that imports by name."""

EFFECTS_OF_OTHERS = ("effect_plugins.py", "importlib.metadata")
"""The one place where the core asks which packages are installed."""
EXCEPTIONS = (READS_A_FILE, LAZY_IMPORTS, EFFECTS_OF_OTHERS)

PORT = {"autotuner.ports", "autotuner.errors", "autotuner.core.recording"}
"""What a driver, ours or another's, may know of the tuner."""

FOR_TYPES = ast.dump(ast.parse("TYPE_CHECKING", mode="eval").body)
SPEAKING = {"breakpoint", "exec", "eval", "input", "open", "print"}


@pytest.fixture(scope="module")
def structure(root):
    spec = importlib.util.spec_from_file_location("structure", root / "benchmarks" / "scale" / "structure.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def sources(root, structure):
    """Return the modules of the packages, parsed, by name."""
    return structure.sources(root)


@pytest.fixture(scope="module")
def parsed(structure):
    """Return a function from a module's path to its tree, which several tests look at."""
    return structure.parsed


def test_no_module_is_in_an_import_circle(structure, sources):
    """Module by module, where the contract looks at rooms and leaves one pair of them out."""
    assert structure.circles(structure.imports(sources)) == []


def test_a_circle_of_any_length_is_found(structure):
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a", "e"}, "e": {"d"}, "f": {"d"}}
    assert structure.circles(graph) == [["a", "b", "c"], ["d", "e"]]


def test_every_number_has_its_unit_and_reason(structure, sources):
    names = {name: structure.undocumented_constants(tree) for name, tree in sources.items()}
    assert {name: found for name, found in names.items() if found} == {}


def test_the_core_imports_numpy_scipy_and_itself(packages, parsed):
    for path in (packages["autotuner"] / "core").rglob("*.py"):
        tree = parsed(path)
        for name in set(_imported(tree)) - _imported_for_types_only(tree):
            own = name.startswith("autotuner.core") or name == "autotuner.errors"
            assert own or name.split(".")[0] in PURE or (path.name, name) in EXCEPTIONS, f"{path}: imports {name}"


def test_the_core_neither_prints_nor_opens(packages, parsed):
    for path in (packages["autotuner"] / "core").rglob("*.py"):
        calls = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
        named = {call.func.id for call in calls if isinstance(call.func, ast.Name)}
        assert not named & SPEAKING, f"{path}: calls {named & SPEAKING}"


def test_drivers_know_only_the_port(packages, parsed):
    for path in packages["autotuner_drivers"].rglob("*.py"):
        tree = parsed(path)
        known = {name for name in _imported(tree) if name.split(".")[0] == "autotuner"}
        assert known <= PORT, path


def test_nothing_imports_a_folder_of_the_repository(modules, parsed):
    for path in modules:
        tops = {name.split(".")[0] for name in _imported(parsed(path))}
        assert not tops & {"drivers", "sim", "models", "tests"}, path


def test_functions_are_short(modules, parsed):
    lengths = {
        f"{path}:{node.name}": node.end_lineno - node.lineno + 1
        for path in modules
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    assert statistics.median(lengths.values()) <= 10
    assert statistics.quantiles(lengths.values(), n=10)[-1] <= 40
    assert {name: length for name, length in lengths.items() if length > 60} == {}


def test_every_module_opens_with_what_it_is(modules, parsed):
    assert [path for path in modules if not ast.get_docstring(parsed(path))] == []


def _imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


def _imported_for_types_only(tree):
    """Imports under `if TYPE_CHECKING`, which no running program sees."""
    guards = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.dump(node.test) == FOR_TYPES]
    return {name for guard in guards for name in _imported(guard)} - {
        name for node in tree.body if node not in guards for name in _imported(node)
    }
