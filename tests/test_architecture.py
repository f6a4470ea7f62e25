"""Which module may import which, and one file per foreign library."""

import ast
import re
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("cosim", "sensors", "trust", "results", "sumo_nets")

FOREIGN = {
    "sensors": {"annotated_types", "jaxtyping", "numpy", "scipy", "numba", "llvmlite", "shapely", "embreex", "open3d"},
    "trust": {"annotated_types", "jaxtyping", "numpy", "numba", "scipy"},
    "results": {
        "annotated_types", "jaxtyping", "numpy", "numba", "scipy", "pyarrow", "pandas", "networkx", "matplotlib",
        "mcap", "yaml",
    },
    "sumo_nets": {"annotated_types", "jaxtyping", "numpy", "scipy", "shapely", "osmium", "sumo", "sumolib"},
    "cosim": {
        "annotated_types", "jaxtyping", "numpy", "scipy", "numba", "libsumo", "pyarrow", "pydantic", "typer", "rich",
        "tomli_w", "shapely", "trimesh", "rerun", "pandas", "distributed", "psutil",
        "latex2mathml",
    },
}  # fmt: skip
"""Foreign libraries that each room may use."""

ONE_FILE = {
    "libsumo": {"cosim/traffic/sumo.py"},
    "embreex": {"sensors/raycast/embree.py"},
    "llvmlite": {"sensors/lanes.py"},
    "open3d": {"sensors/raycast/open3d.py"},
    "pydantic": {"cosim/config/data.py"},
    "rerun": {"cosim/addons/export/view.py", "cosim/addons/export/live.py"},
    "trimesh": {"cosim/traffic/meshes.py"},
    "mcap": {"cosim/addons/export/ros2.py"},
    "osmium": {"cosim/addons/netbuild/osm_pbf.py"},
    "distributed": {
        "cosim/runs/cluster.py",
        "cosim/addons/cells/placed.py",
        "cosim/studies/engine.py",
    },
    "psutil": {"cosim/studies/engine.py"},
    "latex2mathml": {"cosim/docs/equations.py"},
    "yaml": {"cosim/addons/datasets/opv2v.py"},
}
"""Libraries that one file alone may know."""

ORDER = (
    "rng", "ragged", "world", "mobility", "radio", "v2x", "adversary", "driver", "door", "extend", "config", "step",
    "execution", "offline", "tryout", "studies", "predict", "reproduce", "validation", "bench", "benchmark", "cli",
    "docs", "__main__",
)  # fmt: skip
"""The rooms of `cosim`, from foundation to roof: each may import those before it."""

HALL = {"__init__", "__main__", "extend", "rng", "ragged", "world"}
"""The files that stand in `cosim` itself."""


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


def test_rooms_import_neither_each_other_nor_the_tests():
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


@pytest.mark.parametrize("library", ONE_FILE)
def test_one_file(library):
    files = {path.as_posix() for path, module in EDGES if module.split(".")[0] == library}
    assert files == ONE_FILE[library]


def test_matplotlib_only_among_the_figures():
    files = {path.as_posix() for path, module in EDGES if module.split(".")[0] == "matplotlib"}
    assert files and all(f.startswith("results/figures/") for f in files)


def test_the_hall_holds_its_foundation_alone():
    assert {path.stem for path in (ROOT / "cosim").glob("*.py")} == HALL


def test_order_of_the_rooms_of_cosim():
    wrong = []
    for path, module in EDGES:
        parts = module.split(".")
        if path.parts[0] != "cosim" or parts[0] != "cosim" or len(parts) < 2 or module == "cosim.__version__":
            continue
        me, other = path.parts[1].removesuffix(".py"), parts[1]
        if me == "docs" and other in ("Simulation", "run", "open_run"):  # a page imports what a notebook does
            continue
        if me not in ("__init__", other) and ORDER.index(other) >= ORDER.index(me):
            wrong.append(f"{path} imports {module}")
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
        wrong += [f"{path} imports {name}" for name in ours if re.match("_[^_]", name)]
        wrong += [f"{path} uses {of}.{name}" for of, name in used if of in ours and re.match("_[^_]", name)]
    assert not wrong


DOORS = {
    "mobility": {"rng", "world"},
    "radio": {"rng", "ragged"},
    "v2x": {"rng", "ragged", "world", "radio"},
    "adversary": {"rng", "world", "v2x"},
    "driver": {"rng", "ragged", "world"},
}
"""Rooms of `cosim` that need less than their place in the order allows, and what each may use."""


@pytest.mark.parametrize("room", DOORS)
def test_doors_inside_cosim(room):
    used = {
        module.split(".")[1] for path, module in EDGES
        if path.parts[:2] == ("cosim", room) and module.startswith("cosim.")
    }  # fmt: skip
    assert used & set(ORDER) <= DOORS[room] | {room}


def test_the_radio_carries_messages_without_their_content():
    """It knows stations, lengths and times: neither trust nor tables."""
    assert not [
        f"{path} imports {module}" for path, module in EDGES
        if path.parts[:2] == ("cosim", "radio") and module.split(".")[0] in ("trust", "results", "sumo_nets")
    ]  # fmt: skip


def names_in(path):
    """Every name, attribute, argument and keyword of a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        for field in ("id", "attr", "arg", "name"):
            if isinstance(value := getattr(node, field, None), str):
                yield value


def test_trust_has_no_name_of_truth():
    paths = sorted((ROOT / "trust").rglob("*.py"))
    assert paths
    assert not [f"{path}: {name}" for path in paths for name in names_in(path) if "truth" in name.lower()]
