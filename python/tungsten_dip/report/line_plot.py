"""A curve for a page, as an SVG."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

WIDTH = 720
LEFT, RIGHT, TOP, BOTTOM = 110, 24, 20, 40
"""Width of a plot and its margins in the units of the SVG."""


@dataclass(frozen=True)
class Point:
    """A place in a plot, as parts of its width and height from the lower left corner, and its tooltip."""

    x: float
    y: float
    tooltip: str


@dataclass(frozen=True)
class Label:
    """A text at a part of an axis; ``anchor`` is the SVG's: start, middle or end."""

    at: float
    text: str
    anchor: str = "middle"


def line_plot(
    name: str, points: Sequence[Point], below: Iterable[Label], beside: Iterable[Label], height: int
) -> str:
    """Return a curve through points with tooltips, and a gridline at every label beside it."""
    right, bottom = WIDTH - RIGHT, height - BOTTOM

    def across(x: float) -> str:
        return f"{LEFT + x * (right - LEFT):.1f}"

    def up(y: float) -> str:
        return f"{bottom - y * (bottom - TOP):.1f}"

    drawn = []
    for label in beside:
        y = up(label.at)
        drawn.append(f'<line class="gridline" x1="{LEFT}" x2="{right}" y1="{y}" y2="{y}"/>')
        text = escape(label.text)
        drawn.append(f'<text x="{LEFT - 8}" y="{y}" dy="4" text-anchor="end">{text}</text>')
    for label in below:
        place = f'x="{across(label.at)}" y="{height - 14}" text-anchor="{label.anchor}"'
        drawn.append(f"<text {place}>{escape(label.text)}</text>")
    line = " ".join(f"{across(point.x)},{up(point.y)}" for point in points)
    drawn.append(f'<polyline class="curve" points="{line}"/>')
    for point in points:
        place = f'cx="{across(point.x)}" cy="{up(point.y)}" r="3"'
        drawn.append(f"<circle {place}><title>{escape(point.tooltip)}</title></circle>")
    box = f'viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(name)}"'
    return f'<svg class="curve-plot" {box}>{"".join(drawn)}</svg>'
