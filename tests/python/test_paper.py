"""The published method: what goes in, the schedule, determinism, how it ends."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tungsten_dip.buffers.display import ldr_from_radiance, radiance_from_ldr  # noqa: E402
from tungsten_dip.buffers.render_buffers import CHANNELS, Buffer, RenderBuffers  # noqa: E402
from tungsten_dip.errors import InputError  # noqa: E402
from tungsten_dip.fit import denoise  # noqa: E402
from tungsten_dip.fit.paper.fit import BACKTRACK_DB, INPUT_NOISE_STD, PaperFit, fit_paper, learning_rate  # noqa: E402
from tungsten_dip.fit.paper.images import paper_images  # noqa: E402
from tungsten_dip.fit.settings import FitSettings  # noqa: E402
from tungsten_dip.progress import silent  # noqa: E402

HEIGHT, WIDTH = 13, 22


def settings(**changes):
    return FitSettings(**{"preset": "paper", "channels": (4, 6), "device": "cpu", "threads": 1, **changes})


def fitted(buffers, chosen, progress=silent):
    return fit_paper(buffers, chosen, progress, warm_start=None)


def noise_buffers(height=HEIGHT, width=WIDTH, **changes):
    """Every plane of every quantity, all of them varying."""
    random = np.random.default_rng(3)

    def planes(channels):
        return Buffer(*random.random((4, height, width, channels), dtype=np.float32))

    return RenderBuffers(**{**{name: planes(count) for name, count in CHANNELS.items()}, **changes})


def smooth_buffers():
    """A colour ramp of moderate radiance, and nothing else."""
    y, x = np.mgrid[0:1:16j, 0:1:24j]
    return RenderBuffers(Buffer(np.stack([x, y, 0.5 + 0 * x], axis=2).astype(np.float32)))


@pytest.mark.parametrize(
    ("inputs", "given", "random"),
    [
        ("random", 0, 3),
        ("normals", 12, 0),
        ("depths", 12, 0),
        ("albedos", 12, 0),
        ("all", 39, 0),
        ("all+random", 39, 3),
    ],
)
def test_input_modes_have_as_many_channels_as_published(inputs, given, random):
    images = paper_images(noise_buffers(), settings(inputs=inputs))
    assert (images.given.shape, images.random_channels) == ((HEIGHT, WIDTH, given), random)
    assert images.wanted.shape == (HEIGHT, WIDTH, 3)
    assert images.given.dtype == images.wanted.dtype == np.float32
    assert images.notes == ()


def test_ioc_asks_for_colour_and_features_of_random_input():
    buffers = noise_buffers()
    images = paper_images(buffers, settings(scheme="ioc"))
    assert (images.given.shape[2], images.random_channels, images.wanted.shape[2]) == (0, 3, 39)
    np.testing.assert_array_equal(images.wanted[:, :, :3], ldr_from_radiance(buffers.color.mean))
    result = fitted(buffers, settings(scheme="ioc", iterations=2))
    assert result.color.shape == (HEIGHT, WIDTH, 3)


def test_features_are_scaled_as_tungsten_writes_them():
    y, x = np.mgrid[0:4, 0:5].astype(np.float32)
    normal = np.stack([x / 2 - 1, 1 - y / 1.5, 0 * x + (x > 2)], axis=2)
    depth = (x + 10 * y)[:, :, None]
    buffers = RenderBuffers(
        Buffer(np.zeros((4, 5, 3), np.float32)),
        normal=Buffer(normal),
        depth=Buffer(depth, variance=depth),
        albedo=Buffer(3 * np.abs(normal)),
    )
    normals = paper_images(buffers, settings(inputs="normals")).given
    np.testing.assert_allclose(normals, (normal + 1) / 2)
    depths = paper_images(buffers, settings(inputs="depths")).given
    np.testing.assert_allclose(depths[:, :, :3], np.repeat(depth / 34, 3, axis=2), rtol=1e-6)
    np.testing.assert_array_equal(depths[:, :, 3:], np.repeat(np.minimum(depth, 1), 3, axis=2))
    np.testing.assert_array_equal(
        paper_images(buffers, settings(inputs="albedos")).given, np.clip(3 * np.abs(normal), 0, 1)
    )


def test_gamma_round_trip():
    radiance = np.linspace(0, 1, 11, dtype=np.float32)
    np.testing.assert_allclose(radiance_from_ldr(ldr_from_radiance(radiance)), radiance, rtol=1e-5)
    assert ldr_from_radiance(np.float32([-1, 7])).tolist() == [0, 1]


def test_constant_channels_do_not_reach_the_network():
    flat = np.ones((HEIGHT, WIDTH, 3), np.float32)
    images = paper_images(noise_buffers(normal=Buffer(flat, flat, flat, flat)), settings(inputs="all"))
    assert images.given.shape[2] == 27
    assert (images.given.min((0, 1)) < images.given.max((0, 1))).all()
    assert any("12 of 39" in note and "constant" in note for note in images.notes)
    with pytest.raises(InputError, match=r"constant.*use inputs random"):
        paper_images(noise_buffers(normal=Buffer(flat)), settings(inputs="normals"))


@pytest.mark.parametrize(
    ("inputs", "quantity"), [("normals", "normal"), ("depths", "depth"), ("albedos", "albedo")]
)
def test_a_missing_feature_is_named(inputs, quantity):
    with pytest.raises(
        InputError, match=rf"inputs {inputs}: expected the buffer {quantity}, .*use inputs all"
    ):
        paper_images(noise_buffers(**{quantity: None}), settings(inputs=inputs))


def test_all_uses_what_is_there_and_says_so():
    buffers = noise_buffers()
    buffers = buffers.with_quantities(depth=None, normal=Buffer(buffers.normal.mean))
    images = paper_images(buffers, settings(inputs="all"))
    assert images.given.shape[2] == 3 + 12 + 3
    assert len(images.notes) == 2
    assert "half_a, half_b, variance" in images.notes[0]
    assert images.notes[1].startswith("depth: no mean")


def test_overfits_a_tiny_image():
    buffers = smooth_buffers()
    result = fitted(buffers, settings(iterations=400, inputs="all+random", channels=(8, 16)))
    error = np.mean((ldr_from_radiance(result.color) - ldr_from_radiance(buffers.color.mean)) ** 2)
    assert -10 * np.log10(error) > 25
    assert [point.iteration for point in result.history] == [100, 200, 300, 400]
    assert all(point.estimated_relmse is None for point in result.history)


@pytest.mark.parametrize("network", ["skip", "resnet"])
def test_same_seed_same_bits_and_nothing_global_changes(network):
    torch.manual_seed(1)
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    first, again, other = (
        fitted(noise_buffers(), settings(iterations=3, network=network, seed=seed)).color
        for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_num_threads() == threads


def new_fit(**changes):
    chosen = settings(**changes)
    return PaperFit(paper_images(smooth_buffers(), chosen), chosen, torch.device("cpu"))


def test_learning_rate_falls_while_the_loss_is_low():
    assert [learning_rate(loss) for loss in (1e-2, 5.1e-4, 4.9e-4)] == [1e-3, 1e-3, 1e-4]
    fit = new_fit()
    fit.step()
    before = [weight.detach().clone() for weight in fit.network.parameters()]
    fit.step()
    moved = max(
        (now - was).abs().max().item() for now, was in zip(fit.network.parameters(), before, strict=True)
    )
    assert 0.3e-3 < moved < 3e-3


def test_backtracks_when_the_output_gets_much_worse():
    fit = new_fit(channels=(8, 16))
    for _ in range(60):
        fit.step()
    good_psnr = fit.psnr
    good = fit._good_weights.clone()
    with torch.no_grad():
        for weight in fit.network.parameters():
            weight.mul_(-3)
    fit.step()
    assert fit.psnr < good_psnr - BACKTRACK_DB
    assert torch.equal(
        torch.cat(
            [
                weight.movedim(1, -1).flatten() if weight.dim() == 4 else weight
                for weight in fit.network.parameters()
            ]
        ),
        good,
    )
    fit.step()
    assert fit.psnr > good_psnr - BACKTRACK_DB


def test_backtracks_from_nan():
    fit = new_fit()
    fit.step()
    with torch.no_grad():
        next(fit.network.parameters()).fill_(float("nan"))
    fit.step()
    assert all(torch.isfinite(weight).all() for weight in fit.network.parameters())
    assert np.isfinite(fit.color()).all()


def test_output_is_the_running_average(monkeypatch):
    outputs = iter([0.25, 0.5, 0.75])
    fit = new_fit()
    bias = torch.zeros(1, requires_grad=True)
    monkeypatch.setattr(fit, "network", lambda image: (next(outputs) + bias).expand(1, 3, *image.shape[2:]))
    for _ in range(3):
        fit.step()
    ldr = 0.99 * (0.99 * 0.25 + 0.01 * 0.5) + 0.01 * 0.75
    np.testing.assert_allclose(ldr_from_radiance(fit.color()), ldr, rtol=1e-4)


def test_input_noise_is_fresh_and_of_the_published_strength():
    fit = new_fit()
    seen = []
    fit.network.register_forward_pre_hook(lambda _, args: seen.append(args[0].clone()))
    for _ in range(4):
        fit.step()
    noise = torch.stack(seen) - fit._input
    assert noise.std().item() == pytest.approx(1 / 30, rel=0.05)
    correlation = torch.corrcoef(noise.flatten(1))
    assert (correlation - torch.eye(4)).abs().max() < 0.15


def test_time_budget_ends_the_fit_after_at_least_one_iteration():
    result = fitted(noise_buffers(), settings(time_budget_s=1e-6))
    assert result.iterations == 1
    assert "the time budget ended at iteration 1 of 3000" in result.notes


def test_interrupt_returns_the_average_so_far():
    def stop(fraction, message):
        if message.startswith("iteration 3"):
            raise KeyboardInterrupt

    interrupted = fitted(noise_buffers(), settings(iterations=9), stop)
    assert interrupted.iterations == 3
    assert interrupted.interrupted
    assert "interrupted at iteration 3 of 9" in interrupted.notes
    whole = fitted(noise_buffers(), settings(iterations=3))
    assert not whole.interrupted
    np.testing.assert_array_equal(interrupted.color, whole.color)


def test_progress_grows_to_one_and_tells_loss_and_psnr():
    told = []
    fitted(noise_buffers(), settings(iterations=4), lambda *point: told.append(point))
    assert [fraction for fraction, _ in told] == [0.25, 0.5, 0.75, 1.0]
    assert all("loss" in message and "PSNR to noisy" in message for _, message in told)


def test_notes_tell_of_clipped_highlights_and_the_missing_error_estimate():
    buffers = noise_buffers()
    buffers.color.mean[0, 0] = 50
    result = fitted(buffers, settings(iterations=1, target_error=0.1, pilot="oidn"), silent)
    for words in ("no error estimate", "clips highlights", "target_error is not used", "pilot is not used"):
        assert any(words in note for note in result.notes)
    assert result.error is None
    assert result.color.max() <= 1


def test_one_pixel_and_none():
    assert fitted(noise_buffers(1, 1), settings(iterations=2, inputs="all+random")).color.shape == (
        1,
        1,
        3,
    )
    with pytest.raises(InputError, match="at least one pixel, got 5x0"):
        denoise(noise_buffers(0, 5), settings())


def test_nan_is_refused():
    buffers = noise_buffers()
    buffers.albedo.mean[2, 3, 1] = np.nan
    with pytest.raises(InputError, match="without NaN"):
        fitted(buffers, settings())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_an_input_error():
    with pytest.raises(InputError, match="device cuda"):
        fitted(noise_buffers(), settings(device="cuda"))


def test_bfloat16_moves_the_network_by_less_than_its_input_noise():
    fit = PaperFit(paper_images(noise_buffers(48, 64), settings()), settings(), torch.device("cpu"))
    x = torch.rand(1, 42, 48, 64, generator=torch.Generator().manual_seed(0))
    noise = INPUT_NOISE_STD * torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        exact, noisy = fit.network(x), fit.network(x + noise)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = fit.network(x).float()
    assert 0 < (rounded - exact).std() < 0.5 * (noisy - exact).std()


@contextmanager
def default(set_default, value, before):
    set_default(value)
    try:
        yield
    finally:
        set_default(before)


@pytest.mark.parametrize(
    "context",
    [
        torch.no_grad,
        torch.inference_mode,
        lambda: torch.device("meta"),
        lambda: default(torch.set_default_dtype, torch.float64, torch.float32),
        lambda: default(torch.set_default_device, "meta", None),
        lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    ],
    ids=["no_grad", "inference_mode", "device", "default dtype", "default device", "autocast"],
)
@pytest.mark.parametrize("network", ["skip", "resnet"])
def test_the_callers_settings_of_torch_change_nothing(context, network):
    buffers, chosen = smooth_buffers(), settings(iterations=3, network=network)
    expected = fitted(buffers, chosen).color
    with context():
        color = fitted(buffers, chosen).color
    np.testing.assert_array_equal(color, expected)


def test_fits_in_several_threads_give_the_image_of_one():
    buffers, chosen = smooth_buffers(), settings(iterations=1)
    expected = fitted(buffers, chosen).color
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: fitted(buffers, chosen), range(24)):
            np.testing.assert_array_equal(result.color, expected)
