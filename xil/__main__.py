"""`python -m xil` is the command line, for child processes that must not depend on PATH."""

from xil.cli import main

main()
