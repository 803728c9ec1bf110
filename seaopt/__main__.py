"""The command `seaopt`, also as `python -m seaopt`: Ctrl-C is one line and exit code 130 from the first import on."""

from __future__ import annotations

import gc
import os
import signal
import sys
from contextlib import suppress
from typing import NoReturn

from seaopt import __version__

COLLECTED = 10_000  # new objects between collections, which by default take a sixth of a whole run


def main() -> None:
    """Run the command line."""
    if sys.argv[1:] == ["--version"]:  # asked by scripts, and all else that a command loads takes ten times as long
        with suppress(OSError):  # nobody reads it
            os.write(1, f"seaopt {__version__}\n".encode())
        return
    gc.set_threshold(COLLECTED)
    # Before NumPy is loaded: threads cost these small problems more than they bring.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else nobody may interrupt it, as below nohup
        signal.signal(signal.SIGINT, _leave)  # an import that is interrupted may raise anything, anywhere
    from seaopt.cli.main import main as run

    try:
        signal.signal(signal.SIGINT, before)
        run()
    except KeyboardInterrupt:  # between the two handlers
        _leave()


def _leave(*_: object) -> NoReturn:
    os.write(2, b"\nseaopt: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
