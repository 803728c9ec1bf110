"""Run the command line as `python -m seaopt.cli`."""

from seaopt.cli.main import main

main()
