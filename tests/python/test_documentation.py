"""The documentation: its Python examples run as they stand, and its links lead somewhere."""

import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from synthetic import SyntheticRender
from tungsten_dip.buffers.render_buffers import TRAITS, Quantity
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.fit import FitResult

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])


@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_the_examples_of_a_page_are_a_program(page: str, render: SyntheticRender, tmp_path: Path) -> None:
    write_tungsten_folder(tmp_path / "renders" / "kitchen", render.buffers)
    examples = re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(examples)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "kitchen.exr").is_file()


def test_every_field_of_a_result_is_documented() -> None:
    page = (ROOT / "docs" / "python.md").read_text()
    table = page.partition("The fields of `result`")[2].partition("\n## ")[0]
    documented = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert documented == [field.name for field in fields(FitResult)]


@pytest.mark.parametrize("quantity", sorted(TRAITS.keys() - {"color"}))  # whose row holds the top level
def test_the_layers_of_every_quantity_are_documented(quantity: Quantity) -> None:
    row = re.search(rf"^\| {quantity} \| (.*) \|$", (ROOT / "docs" / "files.md").read_text(), re.MULTILINE)
    assert row is not None
    layers = re.findall(r"`([^`]+)`", row[1])
    assert tuple(layer.lower() for layer in layers) == TRAITS[quantity].layers


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_a_page_and_a_heading(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        other = page.parent / name if name else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other), target
