"""An interrupt ends a command in one line with status 130, whatever compiled code makes of it."""

import os
import signal

import pytest

from cosim.cli.main import main


@pytest.fixture(autouse=True)
def interruptible():
    """A shell without job control starts what it puts into the background with interrupts ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def turned(standalone_mode):
    """Compiled code that takes an interrupt for a wrong type of argument."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        raise TypeError("affine_transform(): incompatible function arguments.") from None


def test_an_interrupt_that_became_another_exception(capsys):
    with pytest.raises(SystemExit) as ended:
        main(turned)
    assert ended.value.code == 130
    assert capsys.readouterr().err == "error: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_exception_without_an_interrupt_is_not_hidden():
    def fails(standalone_mode):
        raise TypeError("as it is")

    with pytest.raises(TypeError, match="as it is"):
        main(fails)
