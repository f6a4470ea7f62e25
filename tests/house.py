"""How big the code is: syntax nodes of each room, and counts of what makes code hard to read.

`python -m tests.house` prints today's numbers as the table `[tool.cosim.house]` of `pyproject.toml`, and the nodes of
each add-on.

Notes
-----
Nodes are those of `ast.walk`, without docstrings: joining lines or leaving out comments changes nothing. A room is a
top-level folder, a folder of `cosim`, or a folder of `tests`; files beside these folders count for the folder above.
The ratchets count in the packages, not in the tests.
"""

import ast
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("cosim", "sensors", "trust", "results", "sumo_nets")
DIVIDED = ("cosim", "tests")
"""Folders whose folders are rooms."""
COMPILED = {"kernel", "compiled", "dividing", "inlined", "parallel", "njit"}
"""Decorators of compiled functions, whose parameters are arrays, because Numba knows no objects."""

DENSE_NODES = 30
LONG_CHARACTERS = 120
MANY_PARAMETERS = 9
TOLERANCE = 0.03
"""A number that is lower than its limit by more than this share has to become the limit."""

RATCHETS = {
    "dense_lines": f"lines with more than {DENSE_NODES} nodes",
    "long_lines": f"lines over {LONG_CHARACTERS} characters",
    "fmt_skips": "lines with `# fmt: skip`",
    "wide_functions": f"functions with {MANY_PARAMETERS} or more parameters outside kernels",
    "shared_class_names": "public names of classes in two or more modules",
}

DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class House:
    """Today's numbers."""

    nodes: Counter[str] = field(default_factory=Counter)
    """By room."""
    ratchets: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(RATCHETS, 0)))


def room_of(path: Path) -> str:
    """The room of a file, named by its path from the root of the repository."""
    depth = 2 if path.parts[0] in DIVIDED else 1
    return "/".join(path.parent.parts[:depth])


def measured(root: Path = ROOT) -> House:
    """Count all Python files of the packages and of the tests."""
    house, modules_of = House(), defaultdict(set)
    for folder in (*PACKAGES, "tests"):
        for file in sorted((root / folder).rglob("*.py")):
            path, text = file.relative_to(root), file.read_text("utf-8")
            tree = ast.parse(text)
            nodes = list(with_lines(tree))
            house.nodes[room_of(path)] += len(nodes)
            if folder == "tests":
                continue
            house.ratchets["dense_lines"] += sum(n > DENSE_NODES for n in per_line(nodes).values())
            house.ratchets["long_lines"] += sum(len(line) > LONG_CHARACTERS for line in text.splitlines())
            house.ratchets["fmt_skips"] += text.count("# fmt: skip")
            house.ratchets["wide_functions"] += sum(is_wide(node) for node, _ in nodes)
            for name in public_classes(tree):
                modules_of[name].add(path)
    house.ratchets["shared_class_names"] = sum(len(modules) > 1 for modules in modules_of.values())
    return house


def with_lines(tree: ast.Module) -> Iterator[tuple[ast.AST, int]]:
    """All nodes without docstrings, each with the line where it begins, or its parent's line if it has none."""
    left: list[tuple[ast.AST, int]] = [(tree, 1)]
    while left:
        node, line = left.pop()
        line = getattr(node, "lineno", line)
        yield node, line
        docstring = docstring_of(node)
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, ast.AST):
                left.append((value, line))
            elif isinstance(value, list):
                left += [(one, line) for one in value if isinstance(one, ast.AST) and one is not docstring]


def per_line(nodes: Iterable[tuple[ast.AST, int]]) -> Counter[int]:
    """How many nodes each line has."""
    return Counter(line for _, line in nodes)


def docstring_of(node: ast.AST) -> ast.stmt | None:
    """The statement with the docstring of a module, a class or a function."""
    if isinstance(node, DOCUMENTED) and node.body and ast.get_docstring(node, clean=False) is not None:
        return node.body[0]
    return None


def is_wide(node: ast.AST) -> bool:
    """Whether a node is a function with many parameters that is not compiled."""
    if not isinstance(node, FUNCTIONS):
        return False
    of = node.args
    n = len(of.posonlyargs) + len(of.args) + len(of.kwonlyargs)
    return n >= MANY_PARAMETERS and not COMPILED & {name_of(one) for one in node.decorator_list}


def name_of(decorator: ast.expr) -> str:
    """The name of a decorator, without the module before it and the arguments behind it."""
    if isinstance(decorator, ast.Call):
        return name_of(decorator.func)
    return ast.unparse(decorator).split(".")[-1]


def public_classes(tree: ast.Module) -> Iterator[str]:
    """Names of the classes of a module that do not begin with an underscore."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node.name


def limits(root: Path = ROOT) -> tuple[dict[str, int], dict[str, int]]:
    """The budgets of rooms and the numbers of the ratchets, as `pyproject.toml` says them."""
    said = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["tool"]["cosim"]["house"]
    return said["nodes"], said["ratchets"]


def problem(found: int, limit: int) -> str:
    """What is wrong with a number; empty if nothing is."""
    if found > limit:
        return f"{found:,} are more than {limit:,}"
    if found < (1 - TOLERANCE) * limit:
        return f"{found:,} are more than {TOLERANCE:.0%} below {limit:,}: lower the number in pyproject.toml"
    return ""


def table(house: House) -> str:
    """The numbers as TOML. Budgets have 1 % to spare, so that a small change needs no new budget."""
    packages = sum(n for room, n in house.nodes.items() if not room.startswith("tests"))
    lines = [f"[tool.cosim.house.nodes]      # packages {packages:,}, tests {house.nodes.total() - packages:,}"]
    lines += [f'"{room}" = {rounded_up(n)}' for room, n in sorted(house.nodes.items())]
    lines += ["", "[tool.cosim.house.ratchets]"]
    lines += [f"{name} = {house.ratchets[name]}      # {meaning}" for name, meaning in RATCHETS.items()]
    return "\n".join(lines)


def rounded_up(n: int) -> int:
    """The next number with three digits that is at least 1 % above n."""
    spare = n + -(-n // 100)
    unit = 10 ** max(0, len(str(spare)) - 3)
    return -(-spare // unit) * unit


def addons(root: Path = ROOT) -> Iterator[tuple[str, int, str]]:
    """Each add-on, the largest first: its name, its nodes, and what users would lose without it."""
    found = []
    for folder in sorted((root / "cosim" / "addons").glob("*/")):
        trees = [ast.parse(file.read_text("utf-8")) for file in folder.rglob("*.py")]
        if trees:
            said = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
            found.append((folder.name, sum(len(list(with_lines(tree))) for tree in trees), said.split("\n\n")[0]))
    yield from sorted(found, key=lambda one: -one[1])


if __name__ == "__main__":
    print(table(measured()))
    print("\n# Without an add-on, users lose:")
    for name, n, said in addons():
        print(f"# {name:13} {n:7,}  {' '.join(said.split())}")
