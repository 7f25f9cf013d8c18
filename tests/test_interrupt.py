import contextlib
import gc
import os
import signal

import pytest

from garat_jax.interrupt import deferred_interrupt, entered_from_c, interruptible, raise_held


def press(number=signal.SIGINT):
    os.kill(os.getpid(), number)


def test_an_interrupt_waits_for_the_end_of_the_block():
    steps = []
    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as interrupted:
        assert not interrupted()
        press()
        steps.append(interrupted())
    assert steps == [True]


def test_a_second_interrupt_does_not_wait():
    with pytest.raises(KeyboardInterrupt), deferred_interrupt():
        press()
        press()
        pytest.fail("the second one was held back")


def test_without_an_interrupt_nothing_happens_and_the_handler_is_back():
    before = signal.getsignal(signal.SIGINT)
    with deferred_interrupt():
        pass
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_a_block(number):
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interruptible():
        press(number)
        pytest.fail("it went on")
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("block", [interruptible, deferred_interrupt])
def test_an_interrupt_never_raises_within_what_c_entered(block):
    reached = []

    @entered_from_c
    def callback():
        press()
        press()
        reached.append("its end")
        with pytest.raises(KeyboardInterrupt):
            raise_held()

    def program():
        callback()
        raise RuntimeError("INTERNAL: the callback failed")

    with pytest.raises(KeyboardInterrupt), block():
        program()
    assert reached == ["its end"]
    raise_held()  # nothing is held any more


def test_errors_that_no_interrupt_made_stay_what_they_are():
    with pytest.raises(RuntimeError, match="no memory"), interruptible():
        raise RuntimeError("no memory")


def test_a_handler_of_the_users_own_for_sigterm_stays():
    came = []
    before = signal.signal(signal.SIGTERM, lambda *_: came.append(1))
    try:
        with deferred_interrupt() as interrupted:
            press(signal.SIGTERM)
            assert came == [1]
            assert not interrupted()
    finally:
        signal.signal(signal.SIGTERM, before)


def test_an_inner_block_takes_sigterm_from_an_outer_one():
    with pytest.raises(KeyboardInterrupt), interruptible(), deferred_interrupt() as interrupted:
        press(signal.SIGTERM)
        assert interrupted()


@pytest.mark.parametrize("block", [interruptible, deferred_interrupt])
def test_an_ignored_interrupt_stays_ignored(block):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with block():
            press()
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_interrupt_that_a_callback_held_ends_the_block():
    @entered_from_c
    def callback():
        press()

    with pytest.raises(KeyboardInterrupt), interruptible():
        callback()


def test_an_interrupt_within_the_collectors_callbacks_ends_the_block():
    def callback(phase, info):
        press()

    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            gc.collect()
    finally:
        gc.callbacks.remove(callback)


def test_an_interrupt_that_was_lost_ends_the_block():
    with pytest.raises(KeyboardInterrupt), interruptible(), contextlib.suppress(BaseException):
        press()
    raise_held()  # nothing is held any more
