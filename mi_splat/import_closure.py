"""The code that a piece of work runs, as a digest: results that are kept belong to it.

Who lists by hand the files that a result depends on forgets one. So the digest is of everything that a module imports,
and what that imports: docstrings, comments, annotations, errors and names of modules apart, with the versions of other
packages. So a module may be moved, and a message reworded.
"""

import ast
import functools
import hashlib
import importlib.metadata
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
"""Folder that holds this package, and those that use it."""
_DISTRIBUTIONS = {"PIL": "pillow"}
"""Packages whose name for pip is another than that by which they are imported."""


@functools.cache
def code_digest(*modules: str) -> str:
    """16 hex digits that stand for the code of some modules and of all that they import.

    What a module loads by its name belongs to them where that name stands in it as a whole, as in a table of modules
    that are imported when they are needed.
    """
    total = hashlib.sha256(f"python {sys.version_info[0]}.{sys.version_info[1]}".encode())
    for code in sorted(_module(name).code for name in closure(*modules)):
        total.update(f"\n{code}".encode())
    for package, version in _versions(closure(*modules)):
        total.update(f"\n{package} {version}".encode())
    return total.hexdigest()[:16]


def closure(*modules: str) -> tuple[str, ...]:
    """Dotted names of some modules and of all that they import from packages beside this one, sorted."""
    names, waiting = set[str](), list(modules)
    while waiting:
        name = waiting.pop()
        if name in names:
            continue
        if _file(name) is None:
            raise ModuleNotFoundError(f"{name}: expected a module below {ROOT}, got none; correct its name")
        names.add(name)
        waiting += [*_imports(name), *(name.rsplit(".", depth)[0] for depth in range(1, name.count(".") + 1))]
    return tuple(sorted(names))


@functools.cache
def _file(name: str) -> Path | None:
    """The file of a module; None if it is none of a package beside this one."""
    if not all(part.isidentifier() for part in name.split(".")):
        return None
    path = ROOT.joinpath(*name.split("."))
    files = (file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file())
    return next(files, None)


@dataclass(frozen=True, slots=True)
class _Module:
    """What is kept of a module's text, which is large as a tree."""

    code: str  # a digest
    modules: tuple[str, ...]  # what `import` names
    names: tuple[tuple[str, str], ...]  # module and name of each `from module import name`
    texts: tuple[str, ...]  # strings that may name a module
    tables: tuple[tuple[str, tuple[object, ...]], ...]  # dictionaries that name modules, and what each of these has


@functools.cache
def _module(name: str) -> _Module:
    file = _file(name)
    assert file is not None
    tree = _Stripped().visit(ast.parse(file.read_text("utf-8")))
    modules, names, texts, tables = list[str](), list[tuple[str, str]](), list[str](), list[tuple[str, Any]]()
    # A package may import its names when they are asked for; who asks for one is followed by `_imported`.
    when_asked = set[ast.AST]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names += [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                if isinstance(key, ast.Constant) and isinstance(value, ast.Tuple):
                    when_asked.add(key)
                    constants = (element for element in value.elts if isinstance(element, ast.Constant))
                    tables.append((str(key.value), tuple(element.value for element in constants)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in when_asked:
            texts += [node.value] if "." in node.value else []
    code = hashlib.sha256(ast.dump(_Nameless().visit(tree)).encode()).hexdigest()
    return _Module(code, tuple(modules), tuple(names), tuple(texts), tuple(tables))


@functools.cache
def _imports(name: str) -> tuple[str, ...]:
    """Modules beside this package that a module imports, at once or in one of its functions."""
    module = _module(name)
    names = [*module.modules, *(_imported(*imported) for imported in module.names), *module.texts]
    return tuple(imported for imported in dict.fromkeys(names) if _file(imported) is not None)


def _imported(module: str, name: str) -> str:
    """The module that `from module import name` leads to, also by way of a package that imports it when it is asked."""
    if _file(f"{module}.{name}") is not None:
        return f"{module}.{name}"
    file = _file(module)
    if file is not None and file.name == "__init__.py":
        return next((home for home, names in _module(module).tables if name in names), module)
    return module


def _versions(names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Packages of others that some modules import, with their versions; those of Python itself have none."""
    modules = map(_module, names)
    used = {name.split(".")[0] for module in modules for name in (*module.modules, *(home for home, _ in module.names))}
    for package in sorted(used - sys.stdlib_module_names):
        if _file(package) is None:
            try:
                yield package, importlib.metadata.version(_DISTRIBUTIONS.get(package, package))
            except importlib.metadata.PackageNotFoundError:
                yield package, "none"


class _Nameless(ast.NodeTransformer):
    """Takes out errors and where our own modules lie, on which no result depends."""

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.ImportFrom:
        """What is imported from a module of ours, wherever that lies."""
        return ast.ImportFrom(module="", names=node.names, level=0) if _file(str(node.module)) is not None else node

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        """The name of a module in a table, likewise."""
        is_module = isinstance(node.value, str) and "." in node.value and _file(node.value) is not None
        return ast.Constant(None) if is_module else node

    def visit_Raise(self, node: ast.Raise) -> ast.Raise:
        """No result comes of an error."""
        return ast.Raise()


class _Stripped(ast.NodeTransformer):
    """Takes out what no result depends on: docstrings, annotations, and imports for type checkers alone."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        """A docstring, of a value too, is a constant that nobody uses."""
        return None if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str) else node

    def visit_If(self, node: ast.If) -> ast.AST | None:
        """A block for type checkers never runs."""
        return None if ast.unparse(node.test).endswith("TYPE_CHECKING") else self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        """A function without the annotation of what it returns."""
        node.returns = None
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """A parameter without its annotation."""
        return ast.arg(arg=node.arg)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        """A variable or a field without its annotation."""
        node.annotation = ast.Constant(None)
        return self.generic_visit(node)
