"""`python -m pumpbench`."""

from pumpbench.cli import main

main()
