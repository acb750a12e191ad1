"""Work for other processes, in a module that imports quickly."""

import os
import signal


def killed(name, report):
    """Ends as the system ends a process that wants too much memory."""
    report(name)
    os.kill(os.getpid(), signal.SIGKILL)
