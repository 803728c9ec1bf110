"""Run the command line as `python -m seaopt`."""

from seaopt.cli.main import main

main()
