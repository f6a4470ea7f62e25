"""`python -m cosim.execution.cells FD FD FD`: the process that forks the workers of a run, which starts it."""

from cosim.execution.cells.worker import main

if __name__ == "__main__":
    main()
