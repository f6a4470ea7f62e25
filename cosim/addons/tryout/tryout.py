"""Tests a class of any kind."""

from collections.abc import Sequence

from cosim.addons.tryout.findings import Report
from cosim.addons.tryout.laws import PARTS, try_part
from cosim.addons.tryout.run_laws import try_exporter, try_metric
from cosim.base.threads import n_threads, use_threads
from cosim.door.kinds import KINDS
from cosim.door.load import is_own, load_own


def try_class(name: str, kind: str | None = None, sets: Sequence[str] = ()) -> Report:
    """Check the laws of a class's interface on a tiny scene.

    Parameters
    ----------
    name
        `path.py:Name` or `package.module:Name`, or the name of an included class.
    kind
        One of `KINDS`. If it is not given, it is found from the methods of the class or from the included names.
    sets
        Parameters of the class, each as `key=value`.

    Raises
    ------
    ValueError
        The class cannot be loaded. The message is one line.
    """
    if kind is None:
        kind = load_own(name).kind.name if is_own(name) else _shipped(name)
    threads = n_threads()
    use_threads(1)  # two threads are slower with sixteen actors
    try:
        if kind in PARTS:
            return try_part(kind, name, sets)
        return (try_exporter if kind == "exporter" else try_metric)(name, sets)
    finally:
        use_threads(threads)


def _shipped(name: str) -> str:
    """The kind of an included class."""
    found = [kind.name for kind in KINDS.values() if name in kind.shipped]
    if not found:
        raise ValueError(f"{name}: no such choice. Name a class of your own as path.py:Name.")
    if len(found) > 1:
        raise ValueError(f"{name} is a choice of several kinds: {', '.join(found)}. Say which one, --kind {found[0]}.")
    return found[0]
