"""Which module may import which, and one file per foreign library."""

import ast
import re
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("cosim", "sensors", "trust", "results", "sumo_nets")

FOREIGN = {
    "sensors": {"annotated_types", "jaxtyping", "numpy", "scipy", "numba", "llvmlite", "shapely", "embreex", "open3d"},
    "trust": {"annotated_types", "jaxtyping", "numpy", "numba", "scipy"},
    "results": {
        "annotated_types", "jaxtyping", "numpy", "numba", "scipy", "pyarrow", "pandas", "duckdb",
        "matplotlib",
    },
    "sumo_nets": {"annotated_types", "jaxtyping", "numpy", "scipy", "shapely", "sumo", "sumolib"},
    "cosim": {
        "annotated_types", "jaxtyping", "numpy", "scipy", "numba", "libsumo", "pyarrow", "pydantic", "typer", "rich",
        "tomli_w", "shapely", "trimesh", "rerun", "pandas", "dask", "distributed", "psutil",
        "latex2mathml", "matplotlib", "mcap", "osmium", "sumolib", "yaml",
    },
}  # fmt: skip
"""Foreign libraries that each room may use."""

ONE_FILE = {
    "libsumo": {"cosim/traffic/sumo_process.py"},
    "embreex": {"sensors/raycast/embree.py"},
    "llvmlite": {"sensors/lanes.py"},
    "open3d": {"sensors/raycast/open3d.py"},
    "pydantic": {"cosim/config/data.py"},
    "rerun": {"cosim/addons/export/view.py", "cosim/addons/export/live.py"},
    "trimesh": {"cosim/traffic/meshes.py"},
    "mcap": {"cosim/addons/export/ros2.py"},
    "osmium": {"cosim/addons/netbuild/osm_pbf.py"},
    "dask": {"cosim/runs/cluster.py"},
    "distributed": {
        "cosim/runs/cluster.py",
        "cosim/studies/engine.py",
    },
    "duckdb": {"results/sql.py"},
    "psutil": {"cosim/studies/engine.py"},
    "latex2mathml": {"cosim/docs/equations.py"},
    "yaml": {"cosim/addons/perception/opv2v.py"},
}
"""Libraries that one file alone may know."""

ORDER = (
    "base", "world", "traffic", "radio", "messages", "attacks", "door", "extend", "config", "step", "runs", "studies",
    "cli", "addons", "docs", "__main__",
)  # fmt: skip
"""The rooms of `cosim`, from foundation to roof: each may import those before it."""

HALL = {"__init__", "__main__", "extend", "world"}
"""The files that stand in `cosim` itself."""


@cache
def files():
    """Path from the root, imports (those inside functions too), and `name.attribute` of every file of the rooms.

    Only the worker that needs them reads all files.
    """
    found = []
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
        used = {(n.value.id, n.attr) for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)}
        found.append((path.relative_to(ROOT), imports, used))
    return found


@cache
def edges():
    """(file, imported module) of every import in the rooms."""
    found = []
    for path, imports, _ in files():
        for node in imports:
            if isinstance(node, ast.Import):
                found += [(path, alias.name) for alias in node.names]
            else:
                assert node.level == 0, f"{path}: relative import"
                found += [(path, node.module), *((path, f"{node.module}.{a.name}") for a in node.names)]
    return found


def room_of(module):
    """The part of the house that a module belongs to: a top-level folder, `cosim.base`, or an add-on."""
    parts = module.split(".")
    if parts[:2] == ["cosim", "addons"] and len(parts) > 2:
        return ".".join(parts[:3])
    return "cosim.base" if parts[:2] == ["cosim", "base"] else parts[0]


def module_of(path):
    """The dotted name of a file."""
    return ".".join(path.with_suffix("").parts)


def test_rooms_import_the_foundation_and_not_each_other():
    """The foundation imports nothing of ours, and nobody imports the tests."""
    wrong = []
    for path, module in edges():
        me, other = room_of(module_of(path)), room_of(module)
        if other not in (*ROOMS, "cosim.base", "tests") and not other.startswith("cosim.addons."):
            continue
        allowed = (
            {me, "cosim.base"} if (me in ROOMS and me != "cosim") or me == "cosim.base" else {me, "cosim.base", *ROOMS}
        )
        if other not in allowed and not other.startswith("cosim.addons."):
            wrong.append(f"{path} imports {module}")
    assert not wrong


def test_core_imports_no_addon_and_no_addon_another():
    """Add-ons are found by name: `cosim.base.addons`."""
    wrong = [
        f"{path} imports {module}" for path, module in edges()
        if room_of(module).startswith("cosim.addons.") and room_of(module) != room_of(module_of(path))
    ]  # fmt: skip
    assert not wrong


@pytest.mark.parametrize("room", ROOMS)
def test_foreign_libraries(room):
    used = {module.split(".")[0] for path, module in edges() if path.parts[0] == room}
    assert used - set(sys.stdlib_module_names) - set(ROOMS) <= FOREIGN[room]


@pytest.mark.parametrize("library", ONE_FILE)
def test_one_file(library):
    files = {path.as_posix() for path, module in edges() if module.split(".")[0] == library}
    assert files == ONE_FILE[library]


def test_matplotlib_only_among_the_figures():
    files = {path.as_posix() for path, module in edges() if module.split(".")[0] == "matplotlib"}
    assert files and all(f.startswith("results/figures/") or f.endswith("figure.py") for f in files)


def test_the_hall_holds_its_foundation_alone():
    assert {path.stem for path in (ROOT / "cosim").glob("*.py")} == HALL


def test_order_of_the_rooms_of_cosim():
    wrong = []
    for path, module in edges():
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
    assert cycle(edges()) == []
    back = (Path("results/run.py"), "results.measure")
    assert set(cycle([*edges(), back])) >= {"results.run", "results.measure"}, "a ring is seen"


def test_private_names_stay_in_their_file():
    wrong = []
    for path, imports, used in files():
        froms = [n for n in imports if isinstance(n, ast.ImportFrom) and n.module.split(".")[0] in ROOMS]
        ours = {name.asname or name.name for n in froms for name in n.names}
        wrong += [f"{path} imports {name}" for name in ours if re.match("_[^_]", name)]
        wrong += [f"{path} uses {of}.{name}" for of, name in used if of in ours and re.match("_[^_]", name)]
    assert not wrong


DOORS = {
    "traffic": {"base", "world"},
    "radio": {"base"},
    "messages": {"base", "world", "radio"},
    "attacks": {"base", "world", "messages"},
}
"""Rooms of `cosim` that need less than their place in the order allows, and what each may use."""


@pytest.mark.parametrize("room", DOORS)
def test_doors_inside_cosim(room):
    used = {
        module.split(".")[1] for path, module in edges()
        if path.parts[:2] == ("cosim", room) and module.startswith("cosim.")
    }  # fmt: skip
    assert used & set(ORDER) <= DOORS[room] | {room}


def test_the_radio_carries_messages_without_their_content():
    """It knows stations, lengths and times: neither trust nor tables."""
    assert not [
        f"{path} imports {module}" for path, module in edges()
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
