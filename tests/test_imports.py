"""The import table of docs/architecture.md against the code."""

import ast
import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "architecture.md"
TOP = ("dsvla_jax", "data_pipelines", "configs", "train", "eval", "plan")
FILES = [file for name in TOP for file in (*ROOT.glob(f"{name}/**/*.py"), *ROOT.glob(f"{name}.py"))]


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(file): file for file in FILES if file != ROOT / "dsvla_jax" / "__init__.py"}


def import_table() -> list[tuple[list[str], set[str]]]:
    """The rows of the page, top floor first: the modules or packages of a room, and the rooms it imports."""
    section = PAGE.read_text().split("## The house", 1)[1].split("\n## ", 1)[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("| `")]
    table = []
    for names, _, imported in ([part.strip() for part in row] for row in rows):
        modules = [path.removesuffix(".py").replace("/", ".") for path in re.findall(r"`([^`]+)`", names)]
        table.append((modules, set(imported.split(", ")) - {"nothing"}))
    return table


TABLE = import_table()


def room_of(module: str) -> int:
    """The row with the longest name that the module lies in."""
    matches = [
        (len(name), row)
        for row, (names, _) in enumerate(TABLE)
        for name in names
        if f"{module}.".startswith(f"{name}.")
    ]
    assert matches, f"{module} is in no row of {PAGE.name}"
    return max(matches)[1]


def imports(file: Path, module: str) -> Iterator[str]:
    """The project's modules that a file imports, dynamic imports included."""
    for node in ast.walk(ast.parse(file.read_text())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{file}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            names = [dynamic_name(node.args[0], module)]
        for name in names:
            while name and name not in MODULES:
                name = name.rpartition(".")[0]
            if name and name != module:
                yield name


def dynamic_name(argument: ast.expr, module: str) -> str:
    """What a call of `import_module` imports: a whole name, or the package that its computed name begins with."""
    first = argument.values[0] if isinstance(argument, ast.JoinedStr) else argument
    if isinstance(first, ast.Constant):
        return str(first.value).rstrip(".")
    assert ast.unparse(argument).startswith("f'{__name__}."), (
        f"{module} imports {ast.unparse(argument)}: say from where"
    )
    return module


GRAPH = {module: set(imports(file, module)) for module, file in MODULES.items()}


def test_there_is_no_circle_of_imports():
    # The package of a module is imported before it, which closes no circle as long as __init__ imports no module of it.
    graphlib.TopologicalSorter(GRAPH).prepare()


@pytest.mark.parametrize("row", range(len(TABLE)), ids=[names[0] for names, _ in TABLE])
def test_a_room_imports_what_its_row_says_and_only_from_below(row: int):
    names, stated = TABLE[row]
    found = {room_of(target) for module in MODULES if room_of(module) == row for target in GRAPH[module]} - {row}
    upwards = {TABLE[other][0][0] for other in found if other < row}
    assert not upwards, f"{names} imports upwards"
    # The third column calls a room by its last name.
    short = {name.rpartition(".")[2]: other for other, (rooms, _) in enumerate(TABLE) for name in rooms}
    assert stated == {"all below"} or {short[name] for name in stated} == found


def test_every_row_names_what_is_there():
    assert all(name in MODULES for names, _ in TABLE for name in names)
