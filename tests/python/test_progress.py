from tungsten_dip.progress import part_of


def test_a_part_takes_its_share_of_the_fraction_and_puts_its_name_first() -> None:
    told: list[tuple[float, str]] = []
    part = part_of(lambda fraction, message: told.append((fraction, message)), 1 / 3, 0.7, "frame 4")
    part(0, "")
    part(1, "fitting")
    assert told == [(1 / 3, "frame 4"), (0.7, "frame 4: fitting")]


def test_parts_of_parts() -> None:
    told: list[tuple[float, str]] = []
    outer = part_of(lambda fraction, message: told.append((fraction, message)), 0.5, 1, "outer")
    part_of(outer, 0, 0.5, "inner")(0.5, "half")
    assert told == [(0.625, "outer: inner: half")]


def test_a_part_without_a_name_leaves_messages_as_they_are() -> None:
    told: list[tuple[float, str]] = []
    part_of(lambda fraction, message: told.append((fraction, message)), 0.5, 1)(0.5, "half")
    assert told == [(0.75, "half")]
