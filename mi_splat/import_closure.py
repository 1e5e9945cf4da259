"""The code that a piece of work runs, as a digest: results that are kept belong to it.

Who lists by hand the files that a result depends on forgets one. So the digest is of
everything that a module imports, and what that imports: docstrings, comments,
annotations, errors and names of modules apart, with the versions of other packages. So
a module may be moved, and a message reworded.
"""

import ast
import functools
import hashlib
import importlib.metadata
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
"""Folder that holds this package, and those that use it."""
_DISTRIBUTIONS = {"PIL": "pillow"}
"""Packages whose name for pip is another than that by which they are imported."""


@functools.cache
def code_digest(*modules: str) -> str:
    """16 hex digits that stand for the code of some modules and of all that they
    import.

    What a module loads by its name belongs to them where that name stands in it as a
    whole, as in a table of modules that are imported when they are needed.
    """
    total = hashlib.sha256(
        f"python {sys.version_info[0]}.{sys.version_info[1]}".encode()
    )
    for code in sorted(_module(name).code for name in closure(*modules)):
        total.update(f"\n{code}".encode())
    for package, version in _versions(closure(*modules)):
        total.update(f"\n{package} {version}".encode())
    return total.hexdigest()[:16]


def closure(*modules: str) -> tuple[str, ...]:
    """Dotted names of some modules and of all that they import from packages beside
    this one, sorted.
    """
    names = set[str]()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in names:
            continue
        if _file(name) is None:
            raise ModuleNotFoundError(
                f"{name}: expected a module below {ROOT}, got none; correct its name"
            )
        names.add(name)
        waiting += [
            *_imports(name),
            *(name.rsplit(".", depth)[0] for depth in range(1, name.count(".") + 1)),
        ]
    return tuple(sorted(names))


@functools.cache
def _file(name: str) -> Path | None:
    """The file of a module; None if it is none of a package beside this one."""
    if not all(part.isidentifier() for part in name.split(".")):
        return None
    path = ROOT.joinpath(*name.split("."))
    files = (
        file
        for file in (path / "__init__.py", path.with_suffix(".py"))
        if file.is_file()
    )
    return next(files, None)


@functools.cache
def _fields(kind: type[ast.AST]) -> tuple[str, ...]:
    """Fields of a kind of node that are code: annotations are none, and contexts follow
    from where a node stands.
    """
    return tuple(
        name
        for name in kind._fields
        if name not in ("annotation", "returns", "type_comment", "kind", "ctx")
    )


class _Module:
    """What is kept of a module's text, which is large as a tree and is read once,
    without what no result depends on.
    """

    def __init__(self, text: bytes) -> None:
        self.modules = list[str]()  # what `import` names
        # module and name of each `from module import name`
        self.names = list[tuple[str, str]]()
        self.texts = list[str]()  # strings that may name a module
        # dictionaries that name modules, and what each of these has
        self.tables = list[tuple[str, list[object]]]()
        # A package may import its names when they are asked for; who asks for one is
        # followed by `_imported`.
        self._when_asked, self._code = set[ast.AST](), list[str]()
        self._read(ast.parse(text))
        self.code = hashlib.sha256(
            "\n".join(self._code).encode("utf-8", "surrogatepass")
        ).hexdigest()
        del self._when_asked, self._code

    def _read(self, value: Any) -> None:
        """A node and all that is below it, or values of one of its fields."""
        if isinstance(value, ast.AST):
            kind: Any = type(value)
            if kind in _NOTED and self._note(value):
                return
            self._code.append(kind.__name__)
            for name in _fields(kind):
                self._read(getattr(value, name))
        elif isinstance(value, list):
            for item in value:
                self._read(item)
            self._code.append("]")
        else:
            self._code.append(repr(value))

    def _note(self, node: ast.AST) -> bool:
        """Note what a node imports or names; whether nothing more of it is code."""
        # a docstring, of a value too, is a constant that nobody uses
        if isinstance(node, ast.Expr):
            return isinstance(node.value, ast.Constant) and isinstance(
                node.value.value, str
            )
        if isinstance(node, ast.If):  # a block for type checkers never runs
            return "TYPE_CHECKING" in (
                getattr(node.test, "id", ""),
                getattr(node.test, "attr", ""),
            )
        is_left_out = isinstance(node, ast.Raise)  # no result comes of an error
        if isinstance(node, ast.Import):
            self.modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            self.names += [(node.module, alias.name) for alias in node.names]
            # wherever a module of ours lies
            is_left_out = _file(node.module) is not None
            if is_left_out:
                self._read(node.names)
        elif isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                if isinstance(key, ast.Constant) and isinstance(value, ast.Tuple):
                    self._when_asked.add(key)
                    found: list[object] = [
                        element.value
                        for element in value.elts
                        if isinstance(element, ast.Constant)
                    ]
                    self.tables.append((str(key.value), found))
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and "." in node.value
        ):
            self.texts += [node.value] if node not in self._when_asked else []
            is_left_out = _file(node.value) is not None  # likewise
        self._code += ["left out"] if is_left_out else []
        return is_left_out


_NOTED = {
    ast.Expr,
    ast.If,
    ast.Import,
    ast.ImportFrom,
    ast.Dict,
    ast.Constant,
    ast.Raise,
}


@functools.cache
def _module(name: str) -> _Module:
    file = _file(name)
    assert file is not None
    return _Module(file.read_bytes())


@functools.cache
def _imports(name: str) -> tuple[str, ...]:
    """Modules beside this package that a module imports, at once or in one of its
    functions.
    """
    module = _module(name)
    names = [
        *module.modules,
        *(_imported(*imported) for imported in module.names),
        *module.texts,
    ]
    return tuple(
        imported for imported in dict.fromkeys(names) if _file(imported) is not None
    )


def _imported(module: str, name: str) -> str:
    """The module that `from module import name` leads to, also by way of a package that
    imports it when it is asked.
    """
    if _file(f"{module}.{name}") is not None:
        return f"{module}.{name}"
    file = _file(module)
    if file is not None and file.name == "__init__.py":
        return next(
            (home for home, names in _module(module).tables if name in names), module
        )
    return module


def _versions(names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Packages of others that some modules import, with their versions; those of Python
    itself have none.
    """
    modules = map(_module, names)
    used = {
        name.split(".")[0]
        for module in modules
        for name in (*module.modules, *(home for home, _ in module.names))
    }
    for package in sorted(used - sys.stdlib_module_names):
        if _file(package) is None:
            try:
                yield (
                    package,
                    importlib.metadata.version(_DISTRIBUTIONS.get(package, package)),
                )
            except importlib.metadata.PackageNotFoundError:
                yield package, "none"
