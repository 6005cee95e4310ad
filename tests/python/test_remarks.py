"""What the library logs, collected block by block, also by blocks of several threads that overlap."""

import logging
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from tungsten_dip.remarks import logging_to, remarks_from_log

LOGGER = logging.getLogger("tungsten_dip")
LOG = logging.getLogger("tungsten_dip.fit")


@pytest.fixture(autouse=True)
def logger_is_left_as_it_was():
    def state():
        return list(LOGGER.handlers), LOGGER.level, LOGGER.propagate

    before = state()
    yield
    assert state() == before


def test_a_block_collects_what_is_logged_within_it():
    LOG.info("before")
    with remarks_from_log() as outer:
        LOG.info("1 %s", "line")
        with remarks_from_log() as inner:
            LOG.warning("within both")
        LOG.debug("too much")
        LOG.info("after the inner one")
    LOG.info("after")
    assert outer == ["1 line", "within both", "after the inner one"]
    assert inner == ["within both"]


def test_blocks_of_threads_that_overlap_collect_their_own_lines_alone():
    barrier = threading.Barrier(2, timeout=60)

    def short():
        with remarks_from_log() as remarks:
            barrier.wait()  # 1: begun first
            barrier.wait()  # 2: both have begun
            LOG.info("of the short one")
        barrier.wait()  # 3: ended first
        return remarks

    def long():
        barrier.wait()
        with remarks_from_log() as remarks:
            barrier.wait()
            LOG.info("of the long one")
            barrier.wait()
            LOG.info("after the short one")
        return remarks

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.submit(short), pool.submit(long)
        assert first.result() == ["of the short one"]
        assert second.result() == ["of the long one", "after the short one"]


def test_a_handler_is_handed_the_lines_of_every_thread():
    lines = []
    handler = logging.Handler(logging.INFO)
    handler.emit = lambda record: lines.append(record.getMessage())
    with logging_to(handler), ThreadPoolExecutor(1) as pool:
        with remarks_from_log() as remarks:
            pool.submit(LOG.info, "of another thread").result()
        LOG.info("of this one")
    assert remarks == []
    assert lines == ["of another thread", "of this one"]
