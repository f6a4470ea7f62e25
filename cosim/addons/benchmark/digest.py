"""A hash of what code does: of its syntax tree, without comments, documentation and layout."""

import ast
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path


def code_digest(files: Iterable[Path]) -> str:
    """Hash of the syntax trees of Python files and of their names; twelve digits.

    Comments, docstrings, and the form in which a line is written have no part in it. Types of nodes, fields that are
    not empty, and values are hashed one after another, so that versions of Python give the same digits.

    Parameters
    ----------
    files
        Python files, in an order that the caller keeps.
    """
    found = hashlib.sha256()
    for path in files:
        found.update(f"{path.name}\n".encode())
        for word in _words(ast.parse(path.read_bytes())):
            found.update(f"{word}\n".encode())
    return found.hexdigest()[:12]


def _words(of: object) -> Iterator[str]:
    """The tree as a sequence of words, without statements that are only a constant, as docstrings are."""
    if isinstance(of, ast.Constant):
        yield f"{type(of.value).__name__} {of.value!r}"
    elif isinstance(of, ast.AST):
        yield f"({type(of).__name__}"
        for name, value in ast.iter_fields(of):
            if value is not None and value != []:
                yield name
                yield from _words(value)
        yield ")"
    elif isinstance(of, list):
        yield "["
        for one in of:
            if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)):
                yield from _words(one)
        yield "]"
    else:
        yield repr(of)
