"""`python -m tests.kernels` writes the list of kernels that a run of the default world needs.

Run it twice where kernels are not cached yet: a run that compiles lists also what its kernels call.
"""

import sys
import tempfile
from pathlib import Path

from numba.core import caching, types
from numba.np.numpy_support import as_dtype

from cosim.runs.speed.kernels import LIST
from tests.processes import set_words


def text_of(of):
    """A type of Numba as `cosim.runs.speed.kernels.types_of` reads it."""
    if isinstance(of, types.Array):
        flags = f"{not of.mutable}, aligned={of.aligned}"
        return f"Array({text_of(of.dtype)}, {of.ndim}, {of.layout!r}, {flags})"
    if isinstance(of, types.BaseNamedTuple):
        named = of.instance_class
        return f"named({', '.join([repr(named.__module__), repr(named.__name__), *map(text_of, of)])})"
    if isinstance(of, types.BaseTuple):
        return f"Tuple(({', '.join(map(text_of, of))},))"
    if isinstance(of, types.Record):
        return f"record({as_dtype(of).descr})"
    return repr(of)


def needed(folder, *sets):
    """Lines of the list for a run of the default world, in the order of need."""
    from cosim.cli.main import main

    found = {}
    load = caching.Cache.load_overload

    def noted(self, signature, target):
        at = self._py_func
        found.setdefault(f"{at.__module__} {at.__qualname__} ({', '.join(map(text_of, signature))},)")
        return load(self, signature, target)

    caching.Cache.load_overload = noted
    sets = set_words(("compute.threads=1", *sets))
    sys.argv = ["cosim", "run", *sets, "--out", str(folder / "run")]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code
    finally:
        caching.Cache.load_overload = load
    return list(found)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        lines = needed(Path(folder), "traffic.duration_s=10")
    LIST.write_text("".join(f"{line}\n" for line in lines if line.split(".")[0] != "numba"))
    print(f"{len(lines)} kernels in {LIST}")
