from threading import Barrier, Thread

import pytest

from cosim.base.deferred import Deferred


def test_a_value_is_computed_once_whoever_asks():
    computed, found, both = [], [], Barrier(2)

    def compute():
        computed.append(1)
        return len(computed)

    value = Deferred(compute)

    def ask():
        both.wait()
        found.append(value())

    threads = [Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [1, 1] and computed == [1]


def test_an_error_is_raised_for_everyone():
    value = Deferred(lambda: 1 // 0)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            value()
