"""Batches of clips that several threads request."""

import functools
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.batching import Batcher, is_compiling
from egosim_jax.rendering import reference
from egosim_jax.types import InputError
from tests.painted import painted


class Counting:
    """Generator that records its batches; a clip of seed 13 fails."""

    renderer = reference
    point_px = 2
    prior = "static"
    chunk_frames = (2,)

    def __init__(self):
        self.batches, self.held = [], threading.Event()
        self.held.set()
        self.compiled, self.compiling = [], threading.Semaphore(0)

    def compile(self, *sizes, streamed):
        assert streamed
        for size in sizes:
            self.compiling.acquire(timeout=30)
            if size == 8:
                raise MemoryError("8 clips do not fit")
            self.compiled.append(size)

    def condition(self, view, action, first_frame):
        return action

    def groups(self, triplets, seeds):
        self.held.wait()
        self.batches.append(list(seeds))
        if 13 in seeds:
            raise FloatingPointError("clip 13")
        frames = np.tile(np.array(seeds, np.uint8)[:, None, None, None, None], (1, 2, 32, 48, 3))
        yield frames[:, :1]
        if 14 in seeds:
            raise FloatingPointError("clip 14")
        yield frames[:, 1:]

    def fingerprint(self):
        return "counting"

    def __call__(self, *_):
        raise AssertionError

    begin = __call__


def wait_until(done):
    until = time.monotonic() + 30
    while not done():
        assert time.monotonic() < until
        time.sleep(0.01)


@functools.cache
def inputs():
    """View, action and first frame of a small scene."""
    actions = ActionSpec()
    start = painted().start(3, actions)
    action, _ = actions.to_action(actions.rest[None], camera=start.camera, prompt="rest")
    return reference.render(start.state, start.camera, point_px=2), action, start.first_frame


def ask(batcher, seed):
    with batcher.announced():
        time.sleep(0.02)
        return int(batcher(*inputs(), seed)[0, 0, 0, 0])


def run(batcher, seeds):
    with ThreadPoolExecutor(len(seeds)) as threads:
        return [threads.submit(ask, batcher, seed) for seed in seeds]


@pytest.fixture
def generator():
    inputs()
    return Counting()


@pytest.fixture
def make_batcher(generator):
    with ExitStack() as stack:
        yield lambda **options: stack.enter_context(closing(Batcher(generator, **options)))


def test_callers_that_announced_themselves_share_a_program(generator, make_batcher):
    batcher = make_batcher(max_batch=4, wait_s=5.0)
    assert [f.result() for f in run(batcher, [1, 2, 3, 4])] == [1, 2, 3, 4]
    assert [sorted(batch) for batch in generator.batches] == [[1, 2, 3, 4]]


def test_the_largest_program_that_is_filled_runs(generator, make_batcher):
    batcher = make_batcher(max_batch=8, wait_s=0.0)
    generator.held.clear()
    first = threading.Thread(target=ask, args=(batcher, 0))
    first.start()
    time.sleep(0.1)
    with ThreadPoolExecutor(7) as threads:
        for seed in range(1, 8):
            threads.submit(ask, batcher, seed)
        time.sleep(0.3)
        generator.held.set()
    first.join()
    assert [len(batch) for batch in generator.batches] == [1, 4, 2, 1]


def test_a_larger_batch_is_taken_as_soon_as_it_is_compiled(generator, make_batcher, capsys):
    batcher = make_batcher(max_batch=8, wait_s=0.0)

    def largest():
        """Return the largest batch of five clips; most of them wait for the first."""
        generator.held.clear()
        with ThreadPoolExecutor(5) as threads:
            asked = [threads.submit(ask, batcher, seed) for seed in range(5)]
            try:
                wait_until(lambda: len(batcher._waiting) >= 3)  # the first batch has one or two
            finally:
                generator.held.set()
        assert [clip.result() for clip in asked] == [0, 1, 2, 3, 4]
        return max(len(batch) for batch in generator.batches)

    generator.compiling.release()
    batcher.compile(behind=True)
    assert generator.compiled == [1]
    assert largest() == 1
    generator.compiling.release()
    wait_until(lambda: batcher.sizes == [1, 2])
    assert largest() == 2
    generator.compiling.release(2)
    wait_until(lambda: not is_compiling())
    assert "at most 4 are generated at once" in capsys.readouterr().err
    assert generator.compiled == batcher.sizes == [1, 2, 4]


def test_a_batch_is_padded_to_the_devices_only(generator, make_batcher):
    batcher = make_batcher(max_batch=4, unit=2, wait_s=0.0)
    assert batcher.sizes == [2, 4]
    assert ask(batcher, 5) == 5
    assert generator.batches == [[5, 5]]
    with pytest.raises(InputError, match="a multiple of 2"):
        make_batcher(max_batch=3, unit=2)


def test_no_group_comes_twice_when_another_clip_of_the_batch_fails(generator, make_batcher):
    batcher = make_batcher(max_batch=2, wait_s=5.0)

    def stream(seed):
        with batcher.announced():
            time.sleep(0.02)
            return [int(frames[0, 0, 0, 0]) for frames in batcher.stream(*inputs(), seed)]

    with ThreadPoolExecutor(2) as threads:
        good, bad = threads.submit(stream, 1), threads.submit(stream, 14)
        assert good.result(timeout=10) == [1, 1]
        with pytest.raises(FloatingPointError, match="clip 14"):
            bad.result(timeout=10)
    assert [len(batch) for batch in generator.batches] == [2, 1, 1]


def test_a_caller_that_fails_before_is_not_waited_for(generator, make_batcher):
    batcher = make_batcher(max_batch=2, wait_s=60.0)

    def fail():
        with batcher.announced():
            raise InputError("no view")

    with ThreadPoolExecutor(2) as threads:
        good, bad = threads.submit(ask, batcher, 1), threads.submit(fail)
        assert good.result(timeout=10) == 1
        with pytest.raises(InputError):
            bad.result()
