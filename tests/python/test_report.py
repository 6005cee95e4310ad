import re
from html.parser import HTMLParser

import numpy as np
import pytest

from browser import assert_page_works
from synthetic import synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.fit.result import FitResult, HistoryPoint
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.report.page import _features, _round_ticks, report_page
from tungsten_dip.report.preview import FALSE_COLORS, GAP_PX, block_means, error_in_false_color, side_by_side

VOID = {"meta", "img", "input", "line", "circle", "polyline", "link", "br"}


class Page(HTMLParser):
    """Checks that tags are closed in order; keeps elements by tag and the text."""

    def __init__(self, html):
        super().__init__()
        self.open, self.elements, self.text = [], [], ""
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def images_of(page):
    return [attributes["alt"] for tag, attributes in page.elements if tag == "img"]


@pytest.fixture
def result(render):
    return FitResult(
        color=render.reference,
        settings=FitSettings(),
        seconds=12.3,
        iterations=400,
        error=np.full((40, 56, 1), 0.04, np.float32),
        estimated_relmse=0.04,
        history=(HistoryPoint(0.5, 10, None), *(HistoryPoint(i * 1.5, i * 50, 0.5 / i) for i in range(1, 9))),
        notes=("no visibility: fitted without <it>",),
    )


def test_a_line_that_was_logged_again_is_shown_once(render, result):
    html = report_page("room", render.buffers, result, [*result.notes, "wrote preview.png", *result.notes])
    assert html.count("no visibility: fitted without") == 1


def test_the_page_shows_everything_and_needs_no_network(render, result):
    html = report_page("A <b>room</b>", render.buffers, result, ["repaired 3 NaN", *result.notes], "filmic")
    page = Page(html)
    images = {attributes["alt"]: attributes["src"] for tag, attributes in page.elements if tag == "img"}
    assert set(images) == {"noisy", "denoised", "albedo", "normal", "depth", "estimated error"}
    assert all(source.startswith("data:image/png;base64,iVBOR") for source in images.values())
    assert images["noisy"] != images["denoised"]
    assert not re.search(r"https?://|@import|src=.(?!data:)|url\(", html)
    for words in (
        "A <b>room</b>",
        "12.3 s",
        "0.04",
        "repaired 3 NaN",
        "fitted without <it>",
        "56 x 40",
        "16 samples",
    ):
        assert words in page.text


def test_the_curve_goes_through_every_point(render, result):
    page = Page(report_page("room", render.buffers, result, result.notes))
    (line,) = (attributes["points"] for tag, attributes in page.elements if tag == "polyline")
    x, y = np.array([point.split(",") for point in line.split()], dtype=float).T
    history = result.history[1:]
    seconds = [point.seconds for point in history]
    levels = [np.log10(point.estimated_relmse) for point in history]
    assert len(x) == len(history)
    # Affine in time and in the logarithm of the error, which falls while y grows downwards.
    np.testing.assert_allclose(np.polyval(np.polyfit(seconds, x, 1), seconds), x, atol=0.2)
    np.testing.assert_allclose(np.polyval(np.polyfit(levels, y, 1), levels), y, atol=0.2)
    assert np.all(np.diff(y) > 0)


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0.006, 0.0099, [0.005, 0.01]),
        (0.0011, 0.03, [0.001, 0.002, 0.005, 0.01, 0.02, 0.05]),
        (0.02, 0.02, [0.02, 0.05]),
        (3e-5, 0.2, [1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1]),
    ],
)
def test_ticks_enclose_the_errors(low, high, ticks):
    assert _round_ticks(low, high) == ticks


@pytest.mark.parametrize("error", [None, 0.1])
def test_what_is_not_known_is_not_shown(error, render):
    buffers = RenderBuffers(Buffer(render.buffers.color.mean))
    fitted = FitResult(render.reference, FitSettings(), 1.0, 10, history=(HistoryPoint(1.0, 10, error),))
    page = Page(report_page("room", buffers, fitted, ()))
    tags = [tag for tag, _ in page.elements]
    assert images_of(page) == ["noisy", "denoised"]
    assert "svg" not in tags
    assert "Error over time" not in page.text
    assert "independent halves" not in page.text
    assert "the colour only" in page.text


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7)])
def test_small_and_broken_pictures_have_a_page_too(height, width):
    small = synthetic_render(height, width)
    color = small.reference.copy()
    color[0, 0] = (np.nan, np.inf, -1)
    error = np.full((height, width, 1), np.nan, np.float32)
    history = (HistoryPoint(0.0, 1, 0.1), HistoryPoint(0.0, 2, 0.1))
    fitted = FitResult(color, FitSettings("paper"), 0.0, 2, error, 0.1, history)
    page = Page(report_page("small", small.buffers, fitted, (), "reinhard"))
    assert "all+random" in page.text
    assert not re.search(r"\bnan\b", page.text)


def test_the_depth_of_the_sky_does_not_hide_the_rest():
    render = synthetic_render(8, 8)
    depth = np.full((8, 8, 1), 2, np.float32)
    depth[:4] = 1e10
    (picture,) = _features(RenderBuffers(Buffer(render.reference), depth=Buffer(depth)))
    assert picture.pixels[0, 0, 0] == 0
    assert picture.pixels[7, 0, 0] == 1


def test_side_by_side_keeps_both_pictures():
    left, right = np.zeros((3, 5, 3), np.float32), np.full((3, 5, 3), 0.5, np.float32)
    pair = side_by_side(left, right)
    assert pair.shape == (3, 5 + GAP_PX + 5, 3)
    np.testing.assert_array_equal(pair[:, :5], left)
    np.testing.assert_array_equal(pair[:, 5:-5], 1)
    np.testing.assert_array_equal(pair[:, -5:], right)


def test_false_colors_run_from_none_to_the_99th_percentile():
    relative = np.linspace(0, 0.5, 1000, dtype=np.float32)
    picture, most = error_in_false_color((relative**2).reshape(20, 50, 1))
    assert most == pytest.approx(np.percentile(relative, 99), rel=1e-3)
    np.testing.assert_allclose(picture[0, 0] * 255, FALSE_COLORS[0], atol=0.01)
    np.testing.assert_allclose(picture[-1, -1] * 255, FALSE_COLORS[-1], atol=0.01)
    luminance = picture.reshape(-1, 3) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) >= -1e-6)


def test_maps_of_one_scale_have_one_brightest_error():
    error = np.full((2, 3, 1), 0.25, np.float32)
    picture, most = error_in_false_color(error, most=0.5)
    assert most == 0.5
    np.testing.assert_allclose(picture * 255, np.broadcast_to(FALSE_COLORS[-1], (2, 3, 3)), atol=0.01)


def test_no_error_at_all_is_dark():
    picture, most = error_in_false_color(np.zeros((2, 3, 1), np.float32))
    assert most == 1
    np.testing.assert_allclose(picture * 255, np.broadcast_to(FALSE_COLORS[0], (2, 3, 3)), atol=0.01)


def test_the_page_works_in_a_browser(render, result, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(report_page("A room with " + "a_long_name" * 9, render.buffers, result, result.notes))
    assert_page_works(path)


@pytest.mark.parametrize("shape", [(6, 4, 3), (7, 5, 3), (7, 5)])
def test_block_means_leave_out_what_fills_no_block(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).random(shape)
    means = block_means(image, 2)
    assert means.shape == (3, 2, *shape[2:])
    np.testing.assert_allclose(means[2, 1], image[4:6, 2:4].mean(axis=(0, 1)))


def test_a_side_shorter_than_a_block_is_one_block() -> None:
    image = np.arange(6.0).reshape(1, 6, 1)
    np.testing.assert_array_equal(block_means(image, 4)[..., 0], [[1.5]])
    np.testing.assert_array_equal(block_means(image, 1), image)
