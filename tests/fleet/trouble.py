"""A file system of fsspec whose files hang, or kill who reads them: ``trouble://WHAT/PATH`` is the local file PATH.

Workers know it because tests/fleet/sitecustomize.py, on their path, registers it.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import time

from fsspec import AbstractFileSystem


class Trouble(AbstractFileSystem):
    protocol = "trouble"

    def get_file(self, rpath, lpath, **_):
        what, _, path = self._strip_protocol(rpath).partition("/")
        match what:
            case "hang":
                time.sleep(1000)
            case "lock":  # compiled code that never lets go of Python's lock
                signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])
                ctypes.PyDLL(None).sleep(1000)
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "slow":
                time.sleep(0.2)
        shutil.copy(f"/{path}", lpath)
