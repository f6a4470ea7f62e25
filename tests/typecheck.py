"""Checks shapes and types of arguments, results and fields while tests run: `pytest --typecheck=trust`.

Every annotated function and dataclass of these packages is checked by jaxtyping and beartype; compiled functions, which
have no annotations, are left alone.
"""

import ast
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader


class _Decorate(ast.NodeTransformer):
    def _decorated(self, node, first, by="typechecked__"):
        decorator = ast.copy_location(ast.Name(by, ast.Load()), node)
        node.decorator_list.insert(0 if first else len(node.decorator_list), decorator)
        return node

    def visit_FunctionDef(self, node):
        """Functions with an annotation; what stands within them is left alone."""
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        self.generic_visit(node.args)
        if node.returns is not None:
            node.returns = self.visit(node.returns)
        annotated = node.returns is not None or any(a.annotation for a in arguments)
        compiled = any("njit" in ast.unparse(d) or "kernel" in ast.unparse(d) for d in node.decorator_list)
        return self._decorated(node, False) if annotated and not compiled else node

    def visit_Subscript(self, node):
        """An axis such as `n+1` becomes one with a name of its own: jaxtyping takes sums only of axes bound before."""
        self.generic_visit(node)
        if isinstance(node.slice, ast.Tuple) and isinstance(axes := node.slice.elts[-1], ast.Constant):
            if isinstance(axes.value, str):
                axes.value = axes.value.replace("+1", "_plus_1")
        return node

    def visit_ClassDef(self, node):
        """Dataclasses, and the methods of every class; protocols become checkable."""
        self.generic_visit(node)
        if any(ast.unparse(base) == "Protocol" for base in node.bases):
            return self._decorated(node, True, "runtime_checkable__")
        is_data = any("dataclass" in ast.unparse(d) for d in node.decorator_list)
        return self._decorated(node, True) if is_data else node


class _Loader(SourceFileLoader):
    def get_code(self, fullname):
        """Compiled anew, with decorators; no bytecode is kept."""
        tree = _Decorate().visit(ast.parse(self.get_data(self.path), self.path))
        return compile(ast.fix_missing_locations(tree), self.path, "exec", dont_inherit=True)

    def exec_module(self, module):
        """With the decorator as a global name."""
        from typing import runtime_checkable

        from beartype import BeartypeConf, beartype
        from jaxtyping import jaxtyped

        vars(module)["typechecked__"] = jaxtyped(typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True)))
        vars(module)["runtime_checkable__"] = runtime_checkable
        super().exec_module(module)


class _Finder(MetaPathFinder):
    def __init__(self, packages):
        self.packages = set(packages)

    def find_spec(self, fullname, path=None, target=None):
        """Modules of the packages asked for."""
        if fullname.split(".")[0] not in self.packages:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def check(packages):
    """Check these packages from now on; none of them may have been imported."""
    assert not set(packages) & set(sys.modules), "imported already"
    sys.meta_path.insert(0, _Finder(packages))
