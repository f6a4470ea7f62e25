"""A process of cells: the one that forks workers, or a worker of another machine (`connect HOST PORT`)."""

import sys

from cosim.addons.cells.worker import connect, main

if __name__ == "__main__":
    if sys.argv[1] == "connect":
        connect(sys.argv[2], int(sys.argv[3]))
    else:
        main()
