"""The networks: counts against the published code, values against plain layers, any size, gradients."""

import pytest

torch = pytest.importorskip("torch")

import torch.nn.functional as F  # noqa: E402, N812

from tungsten_dip.fit.paper import networks  # noqa: E402
from tungsten_dip.fit.paper.networks import ResNet, Skip, mirror_to_multiple  # noqa: E402

TINY = (4, 6)


@pytest.fixture(autouse=True)
def _own_random_numbers():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        yield


def parameters(network):
    return sum(parameter.numel() for parameter in network.parameters())


def channels_last(*shape, dtype=torch.float64):
    return torch.randn(*shape, dtype=dtype).contiguous(memory_format=torch.channels_last)


def randomised(module):
    """In float64, with norms that do not start out as identities."""
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter)
    return module.double()


@pytest.mark.parametrize(
    ("in_channels", "channels", "count"),
    [
        (3, (8, 16, 32, 64, 128), 572_827),
        (42, (8, 16, 32, 64, 128), 575_635),
        (3, (16, 32, 64, 128, 256), 2_268_683),
        (42, (16, 32, 64, 128, 256), 2_274_299),
    ],
)
def test_skip_has_as_many_parameters_as_published(in_channels, channels, count):
    assert parameters(Skip(in_channels, channels=channels)) == count


def test_resnet_has_as_many_parameters_as_published():
    assert parameters(ResNet(3)) == 196_675


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 70), (5, 3), (64, 64), (33, 65)])
@pytest.mark.parametrize("network", [Skip, ResNet])
def test_output_has_the_size_of_the_input(network, height, width):
    output = network(4, 5)(torch.rand(1, 4, height, width))
    assert output.shape == (1, 5, height, width)
    assert torch.isfinite(output).all()


@pytest.mark.parametrize("channels", [(3,), (3, 4), (3, 4, 5, 6)])
def test_skip_takes_any_number_of_scales(channels):
    assert Skip(2, 1, channels)(torch.rand(1, 2, 9, 20)).shape == (1, 1, 9, 20)


def test_mirroring_continues_as_a_mirror_does():
    row = torch.arange(3.0)[None, None, None]
    assert mirror_to_multiple(row, 8, at_least=1)[0, 0, 0].tolist() == [0, 1, 2, 1, 0, 1, 2, 1]
    assert mirror_to_multiple(row, 3, at_least=1).shape == (1, 1, 3, 3)


def test_up_equals_upsampling_and_convolving_layer_by_layer():
    up = randomised(networks._Up(5, 7))
    coarse = channels_last(2, 5, 6, 9) + 3
    edged = F.pad(
        up.norm(F.interpolate(coarse, scale_factor=2, mode="bilinear")), (1, 1, 1, 1), mode="replicate"
    )
    plain = up.blend(F.conv2d(edged, up.conv.weight, up.conv.bias))
    torch.testing.assert_close(up(coarse, None), plain)


@pytest.mark.parametrize("network", [Skip(2, 1, TINY), ResNet(2, 1)])
def test_gradients_are_those_of_the_values(network):
    network = network.double().to(memory_format=torch.channels_last)
    image = channels_last(1, 2, 7, 10)
    weights = list(network.parameters())

    def loss(*_):
        return network(image).square().sum()

    assert torch.autograd.gradcheck(loss, weights, fast_mode=True)


@pytest.mark.parametrize("shape", [(1, 8, 80, 130), (2, 3, 7, 5), (1, 1, 1, 2), (1, 130, 5, 6)])
def test_the_norm_in_bfloat16_is_pytorchs_batch_norm(shape, monkeypatch):
    """But for the rounding of what comes in and out: sums are in float32 at least."""
    monkeypatch.setattr(networks, "_FEW_THREADS", torch.get_num_threads())

    def normed(norm, image):
        x = image.clone().requires_grad_()
        y = norm(x)
        y.backward(wanted.to(y.dtype))
        return y, x.grad, *(parameter.grad for parameter in ours.parameters())

    ours = randomised(networks._NormAct(shape[1])).float()
    image, wanted = ((3 + 2 * channels_last(*shape)).bfloat16() for _ in range(2))
    found = [value.detach().clone() for value in normed(ours, image)]
    ours.zero_grad()
    ours.double()
    expected = normed(
        lambda x: F.leaky_relu(F.batch_norm(x, None, None, ours.weight, ours.bias, True), 0.2), image.double()
    )
    for value, right, tolerance in zip(found, expected, (2**-8, 2**-7, 1e-5, 1e-5), strict=True):
        largest = max(float(right.detach().abs().max()), 1e-4)  # terms of order 1 cancel
        torch.testing.assert_close(value.double(), right.detach(), rtol=0, atol=tolerance * largest)


def test_gradient_reaches_the_input_through_the_upsampling():
    up = randomised(networks._Up(2, 3)).to(memory_format=torch.channels_last)
    assert torch.autograd.gradcheck(lambda x: up(x, None), channels_last(1, 2, 3, 4).requires_grad_())


def test_memory_order_does_not_change_the_values():
    network = Skip(3, 3, TINY).double()
    image = torch.rand(1, 3, 12, 20, dtype=torch.float64)
    expected = network(image)
    network.to(memory_format=torch.channels_last)
    torch.testing.assert_close(network(image.contiguous(memory_format=torch.channels_last)), expected)


def test_eval_changes_nothing():
    network = Skip(3, 3, TINY)
    image = torch.rand(1, 3, 16, 16)
    with torch.no_grad():
        trained = network(image)
        torch.testing.assert_close(network.eval()(image), trained)
