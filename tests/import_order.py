"""Which module imports which, and whether that follows the order of the data (docs/architecture.md)."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGES = {
    "og_pointcloud": ".",
    "og_pointcloud_export": "export",
    "og_pointcloud_open3d": "plugins",
    "og_pointcloud_pyvista": "plugins",
    "og_pointcloud_ros": "plugins",
}
RECORDS = ("errors", "scene", "cloud", "settings", "journal", "models", "kernels")
FOLDERS = (
    "formats",
    "rendering",
    "checking",
    "text",
    "masking",
    "fitting",
    "bundle",
    "ask",
    "mapping",
    "collection",
    "show",
    "evaluate",
    "cli",
)

Edges = dict[str, dict[str, int]]
"""Importing module -> imported module -> line."""


def imports_of(root: Path) -> Edges:
    """All imports among our modules, those inside functions too; not those for type checkers alone."""
    modules = {_name(path, root / place): path for package, place in PACKAGES.items()
               for path in sorted((root / place / package).rglob("*.py"))}  # fmt: skip
    return {name: _imported(path, name, modules) for name, path in modules.items()}


def _name(path: Path, top: Path) -> str:
    return ".".join(path.relative_to(top).with_suffix("").parts).removesuffix(".__init__")


def _imported(path: Path, name: str, modules: dict[str, Path]) -> dict[str, int]:
    found: dict[str, int] = {}
    tree = ast.parse(path.read_text())
    unread = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if id(node) in unread:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            targets = [f"{node.module}.{alias.name}" for alias in node.names]
            targets = [target if target in modules else node.module for target in targets]
        elif isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        else:
            continue
        for target in targets:
            if target in modules and target != name:
                found.setdefault(target, node.lineno)
    return found


def _floor(module: str) -> float:
    """Where a module stands: it may import what stands lower, or beside it in its own folder."""
    package, _, rest = module.partition(".")
    place = rest.split(".")[0]
    if package == "og_pointcloud":
        if not rest:
            return FOLDERS.index("evaluate") + 0.5  # the face, which hosts use and which fetches names when used
        return -1 if place in RECORDS else FOLDERS.index(place) if place in FOLDERS else len(FOLDERS)
    # The exporter writes what the core has made; hosts use the core and the exporter; the command line uses all.
    return FOLDERS.index("evaluate") + (0.3 if package == "og_pointcloud_export" else 0.6)


def upward(edges: Edges) -> list[str]:
    """Imports against the order, as "module:line imports module"."""
    return [
        f"{module}:{line} imports {target}"
        for module, targets in edges.items()
        for target, line in targets.items()
        if _floor(target) > _floor(module)
    ]


def circles(edges: Edges) -> list[list[str]]:
    """Groups of modules that import each other, each sorted (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for target in edges.get(module, {}):
            if target not in index:
                visit(target)
                low[module] = min(low[module], low[target])
            elif target in stack:
                low[module] = min(low[module], index[target])
        if low[module] == index[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in edges:
        if module not in index:
            visit(module)
    return found
