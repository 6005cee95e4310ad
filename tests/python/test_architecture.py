"""Holds the package to the table of layers in docs/architecture.md."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "python" / "tungsten_dip"

FACES = ("__init__.py", "__main__.py")
"""Files of the package itself: they offer what other layers define."""


def layers() -> list[str]:
    """Return the layers of the table, from the top down."""
    table = (ROOT / "docs" / "architecture.md").read_text().split("\n\n")[2]
    return re.findall(r"^\| (\w+) \|", table, flags=re.MULTILINE)[1:]


def layer_of(module: str) -> str:
    """Return the layer of ``tungsten_dip.a.b``; what lies in no folder is of the root."""
    name = module.split(".")[1]
    return name if (PACKAGE / name).is_dir() else "root"


def imported_modules(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_table_lists_every_folder() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert {*folders, "root"} == set(layers())


def parts_of_fit() -> list[str]:
    """Return the folders and modules of the table of a fit, from the top down."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    table = page.partition("| folder or module of `fit/` |")[2].partition("\n\n")[0]
    cells = re.findall(r"^\| (`[^|]*`) \|", table, flags=re.MULTILINE)
    return [name.strip("/") for cell in cells for name in re.findall(r"`(\w+/?)`", cell)]


def test_the_table_of_a_fit_lists_every_module() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    table = page.partition("| folder or module of `fit/` |")[2].partition("\n\n")[0]
    modules = {path.stem for path in (PACKAGE / "fit").rglob("*.py") if path.parent.name != "paper"}
    folders = {path.parent.name for path in (PACKAGE / "fit").glob("*/__init__.py")}
    assert modules - {"__init__"} <= set(re.findall(r"`(\w+)`", table))
    assert sorted(parts_of_fit()) == sorted(
        folders | {path.stem for path in (PACKAGE / "fit").glob("*.py")} - {"__init__"}
    )


@pytest.mark.parametrize("page", ["docs/architecture.md", "CONTRIBUTING.md"])
def test_names_of_code_on_a_page_exist(page: str) -> None:
    sources = [
        *PACKAGE.rglob("*.py"),
        *ROOT.glob("cpp/*"),
        *ROOT.glob("*_ext/*.?pp"),
        *ROOT.glob("tests/*/*.py"),
    ]
    code = "\n".join(path.read_text() for path in sources if path.is_file())
    names = set(re.findall(r"`(?:\w+\.)?(\w*[A-Z_]\w*)`", (ROOT / page).read_text()))
    words = set(re.findall(r"\w+", code))
    assert names - words <= {"x_from_y"}
    assert names


def test_imports_within_a_fit_point_downwards_only() -> None:
    order = parts_of_fit()
    checked, upwards = 0, []
    for path in (PACKAGE / "fit").rglob("*.py"):
        own = path.relative_to(PACKAGE / "fit").with_suffix("").parts[0]
        for module in imported_modules(path):
            parts = module.split(".")
            if own == "__init__" or parts[:2] != ["tungsten_dip", "fit"] or parts[2] == own:
                continue
            checked += 1
            if order.index(parts[2]) < order.index(own):
                upwards.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert upwards == []
    assert checked > 50


def test_imports_point_downwards_only() -> None:
    order = layers()
    checked, upwards = 0, []
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).parts
        if parts[0] in FACES:
            continue
        own = parts[0] if len(parts) > 1 else "root"
        for module in imported_modules(path):
            if not module.startswith("tungsten_dip."):
                continue
            checked += 1
            if order.index(layer_of(module)) < order.index(own):
                upwards.append(f"{path.relative_to(PACKAGE)} imports {module}")
    assert upwards == []
    assert checked > 100
