"""How tests start a program that they want to stop with Ctrl-C."""

import signal


def interruptible() -> None:
    """For `preexec_fn`: the child ends at SIGINT whoever started the tests.

    What a shell starts in the background (`nohup make test &`) ignores SIGINT, and so do its children.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
