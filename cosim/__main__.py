"""`cosim`, and `python -m cosim`."""

import gc
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a few small products; its threads waited in loops, 7 % of a run
gc.set_threshold(100_000, 50, 100)  # imports and arrays leave little garbage; looking for it cost 5 % of a run

from cosim.runs.process import ignore_settings_here  # noqa: E402
from cosim.runs.speed.allocator import share_one_arena  # noqa: E402

share_one_arena()
ignore_settings_here()  # before the first import of what reads them

from cosim.cli.main import main  # noqa: E402

if __name__ == "__main__":
    main()
