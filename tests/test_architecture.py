"""The doors of the house: who may import whom, and one file per foreign library."""

import ast
import re
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("cosim", "sensors", "trust", "results", "sumo_nets")

FOREIGN = {
    "sensors": {"annotated_types", "jaxtyping", "numpy", "scipy", "numba", "shapely", "embreex", "open3d"},
    "trust": {"annotated_types", "jaxtyping", "numpy", "numba"},
    "results": {"annotated_types", "jaxtyping", "numpy", "scipy", "pyarrow", "pandas", "networkx", "matplotlib"},
    "sumo_nets": {"annotated_types", "jaxtyping", "numpy", "shapely", "osmium", "sumo", "sumolib"},
    "cosim": {
        "annotated_types", "jaxtyping", "numpy", "scipy", "numba", "libsumo", "pyarrow", "pydantic", "typer", "rich",
        "tomli_w", "shapely",
    },
}  # fmt: skip
"""What each room may use of what others wrote."""

ONE_WINDOW = {
    "libsumo": {"cosim/mobility/sumo.py"},
    "embreex": {"sensors/raycast/embree.py"},
    "open3d": {"sensors/raycast/open3d.py"},
    "pydantic": {"cosim/config.py"},
    "osmium": {"sumo_nets/osm.py"},
}
"""Libraries that one file alone may know."""

ORDER = ("rng", "ragged", "world", "roster", "mobility", "radio", "v2x", "truth", "config", "manifest", "cycle", "scenario",
         "resweep", "calibrate", "recording", "run", "reproduce", "bench", "screen", "nets", "cli", "__main__")  # fmt: skip
"""Inside the hall: each may use those before it."""


def imports():
    """(file, imported module) of every import in the rooms, those inside functions too."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    yield from ((path, alias.name) for alias in node.names)
                elif isinstance(node, ast.ImportFrom):
                    assert node.level == 0, f"{path}: relative import"
                    yield path, node.module
                    yield from ((path, f"{node.module}.{a.name}") for a in node.names)


EDGES = [(path.relative_to(ROOT), module) for path, module in imports()]


def test_leaves_know_nobody_and_nobody_knows_the_tests():
    wrong = [
        f"{path} imports {module}" for path, module in EDGES
        if ((top := module.split(".")[0]) in (*ROOMS, "tests") and top != path.parts[0] and path.parts[0] != "cosim")
        or module.split(".")[0] == "tests"
    ]  # fmt: skip
    assert not wrong


@pytest.mark.parametrize("room", ROOMS)
def test_foreign_libraries(room):
    used = {module.split(".")[0] for path, module in EDGES if path.parts[0] == room}
    assert used - set(sys.stdlib_module_names) - set(ROOMS) <= FOREIGN[room]


@pytest.mark.parametrize("library", ONE_WINDOW)
def test_one_window(library):
    files = {path.as_posix() for path, module in EDGES if module.split(".")[0] == library}
    assert files == ONE_WINDOW[library]


def test_matplotlib_only_among_the_figures():
    files = {path.as_posix() for path, module in EDGES if module.split(".")[0] == "matplotlib"}
    assert files and all(f.startswith("results/figures/") for f in files)


def test_order_inside_the_hall():
    wrong = []
    for path, module in EDGES:
        parts = module.split(".")
        if path.parts[0] != "cosim" or parts[0] != "cosim" or len(parts) < 2:
            continue
        me, other = path.parts[1].removesuffix(".py"), parts[1]
        if me not in ("__init__", other) and ORDER.index(other) >= ORDER.index(me):
            wrong.append(f"{path} imports {module}")
    assert not wrong


def test_the_radio_carries_messages_without_their_content():
    """It knows stations, lengths and times: neither vehicles nor messages, trust, attacks or tables."""
    known = {"cosim.rng", "cosim.ragged", "cosim.radio", "cosim"}
    wrong = [
        f"{path} imports {module}" for path, module in EDGES
        if path.parts[:2] == ("cosim", "radio")
        and (module.split(".")[0] in ("trust", "results", "sumo_nets")
             or (module.split(".")[0] == "cosim" and ".".join(module.split(".")[:2]) not in known))
    ]  # fmt: skip
    assert not wrong


def cycle(edges):
    """Modules that import each other in a ring, or nothing."""
    graph = {}
    for path, module in edges:
        graph.setdefault(".".join(path.with_suffix("").parts).removesuffix(".__init__"), set()).add(module)
    try:
        TopologicalSorter({m: (others & graph.keys()) - {m} for m, others in graph.items()}).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_no_module_imports_itself_through_others():
    """Imports inside functions and those for types alone count too."""
    assert cycle(EDGES) == []
    back = (Path("results/run.py"), "results.measure")
    assert set(cycle([*EDGES, back])) >= {"results.run", "results.measure"}, "a ring is seen"


def test_private_names_stay_in_their_file():
    wrong = []
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        froms = [n for n in nodes if isinstance(n, ast.ImportFrom) and n.module.split(".")[0] in ROOMS]
        ours = {name.asname or name.name for n in froms for name in n.names}
        used = {(n.value.id, n.attr) for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)}
        wrong += [f"{path} imports {name}" for name in ours if name.startswith("_")]
        wrong += [f"{path} uses {of}.{name}" for of, name in used if of in ours and re.match("_[^_]", name)]
    assert not wrong


def test_names_of_truth_stay_out_of_trust():
    for path in (ROOT / "trust").glob("*.py"):
        assert "truth" not in path.read_text().replace("names of truth", ""), path
