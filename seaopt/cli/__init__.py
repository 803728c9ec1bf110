"""The `seaopt` command: thin, no numerics."""

from seaopt.cli.main import main

__all__ = ["main"]
