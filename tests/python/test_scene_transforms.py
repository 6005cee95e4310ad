"""Transforms against values worked out by hand, and against what an orthonormal frame must satisfy."""

import numpy as np
import pytest

from tungsten_dip.scene.transforms import matrix_from_transform, rotation_matrix


def test_nothing_given_is_the_identity():
    np.testing.assert_array_equal(matrix_from_transform(), np.eye(4))


def test_position_alone_moves():
    np.testing.assert_array_equal(matrix_from_transform((1.0, 2.0, 3.0)) @ [0, 0, 0, 1], [1, 2, 3, 1])


@pytest.mark.parametrize(
    ("degrees", "vector", "expected"),
    [
        ((90, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 90, 0), (0, 0, 1), (-1, 0, 0)),
        ((0, 90, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),
        # About z first, then x, then y.
        ((90, 90, 90), (1, 0, 0), (-1, 0, 0)),
        ((90, 90, 90), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_rotation_turns_axes_as_tungsten_does(degrees, vector, expected):
    np.testing.assert_allclose(rotation_matrix(degrees) @ vector, expected, atol=1e-12)


def test_scale_comes_before_rotation():
    matrix = matrix_from_transform(scale=(2, 3, 4), rotation=(0, 0, 90))
    np.testing.assert_allclose(matrix[:3, :3] @ [1, 0, 0], [0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3] @ [0, 1, 0], [-3, 0, 0], atol=1e-12)


def test_look_at_points_z_at_the_target_and_keeps_y_up():
    matrix = matrix_from_transform((0, 0, 5), look_at=(0, 0, 0), up=(0, 1, 0))
    np.testing.assert_allclose(matrix[:3, 2], [0, 0, -1])
    np.testing.assert_allclose(matrix[:3, 1], [0, 1, 0])
    np.testing.assert_allclose(matrix[:3, 0], [-1, 0, 0])


def test_look_at_along_up_still_gives_a_frame():
    matrix = matrix_from_transform((0, 5, 0), look_at=(0, 0, 0), up=(0, 1, 0))
    np.testing.assert_allclose(matrix[:3, 2], [0, -1, 0])
    assert_right_handed_frame(matrix)


def test_any_choice_of_axes_gives_a_right_handed_frame():
    random = np.random.default_rng(7)
    names = ("look_at", "up", "x_axis", "y_axis", "z_axis")
    for choice in range(2 ** len(names)):
        chosen = [name for bit, name in enumerate(names) if choice >> bit & 1]
        axes = {name: tuple(random.normal(size=3)) for name in chosen}
        assert_right_handed_frame(matrix_from_transform(tuple(random.normal(size=3)), **axes))


def test_an_axis_without_length_is_refused():
    with pytest.raises(ValueError, match="z axis"):
        matrix_from_transform((1, 1, 1), look_at=(1, 1, 1))


def assert_right_handed_frame(matrix):
    frame = matrix[:3, :3]
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1.0)
