"""The size and shape of the code, as numbers that can be compared between revisions.

    python scripts/size.py                 # this tree
    python scripts/size.py --against REV   # a revision beside it
    python scripts/size.py --since REV     # product lines of files that existed at a revision, and of those added since
    python scripts/size.py --folders       # product lines of each folder too

Product is og_pointcloud, export and plugins; every line counts, including comments and docstrings. Circles and upward
imports are those of ``tests/test_import_order.py``, which says where each is.
"""

from __future__ import annotations

import argparse
import ast
import signal
import statistics
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ("og_pointcloud", "export", "plugins")
sys.path.insert(0, str(ROOT / "tests"))

from import_order import circles, imports_of, upward  # noqa: E402 # pyright: ignore[reportMissingImports]

MANY_PARAMETERS = 7


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="The size and shape of the code.")
    parser.add_argument("--against", metavar="REV", help="a revision to show beside this tree")
    parser.add_argument(
        "--since", metavar="REV", help="what stood at a revision, and what was added since, in two rows"
    )
    parser.add_argument("--folders", action="store_true", help="product lines of each folder too")
    arguments = parser.parse_args()
    against = arguments.against
    columns = {"this tree": measure(ROOT)}
    if against:
        with tempfile.TemporaryDirectory() as folder:
            archive = subprocess.run(["git", "archive", against], cwd=ROOT, capture_output=True, check=True).stdout
            with tarfile.open(fileobj=BytesIO(archive)) as files:
                files.extractall(folder, filter="data")
            columns = {against: measure(Path(folder)), **columns}
    print(f"{'':40}" + "".join(f"{name[:12]:>14}" for name in columns))
    for row in columns["this tree"]:
        print(f"{row:40}" + "".join(f"{column[row]:>14}" for column in columns.values()))
    if arguments.since:
        for row, lines in lines_since(arguments.since).items():
            print(f"{row:40}{lines:>14}")
    if arguments.folders:
        for folder, lines in sorted(lines_by_folder(ROOT).items(), key=lambda pair: -pair[1]):
            print(f"{folder:40}{lines:>14}")


def measure(root: Path) -> dict[str, int | str]:
    """The rows of the table for one tree."""
    product = [path for folder in PRODUCT for path in sorted((root / folder).rglob("*.py"))]
    functions = [function for path in product for function in _functions(path)]
    lengths = sorted(_lines_of(function) for function in functions)
    edges = imports_of(root)
    return {
        "product lines": _count(product),
        "product files": len(product),
        "lines of the longest file": max(_count([path]) for path in product),
        "functions": len(functions),
        "lines of a function: median": int(statistics.median(lengths)),
        "lines of a function: 90th percentile": lengths[len(lengths) * 9 // 10],
        "lines of a function: longest": lengths[-1],
        f"functions of more than {MANY_PARAMETERS} parameters": sum(
            _parameters(function) > MANY_PARAMETERS for function in functions
        ),
        "modules at the package's root": len(list((root / "og_pointcloud").glob("*.py"))) - 1,
        "import circles": len(circles(edges)),
        "upward imports": len(upward(edges)),
        "files from fit to the blending line": len(path_between(edges, *_ends(root))),
        "test lines": _count((root / "tests").rglob("*.py")),
        "example and script lines": _count([*(root / "examples").rglob("*.py"), *(root / "scripts").rglob("*.py")]),
    }


def lines_by_folder(root: Path) -> dict[str, int]:
    """Product lines of each folder, including its subfolders; "og_pointcloud" is the modules at its root."""
    lines: dict[str, int] = {}
    for path in (path for folder in PRODUCT for path in (root / folder).rglob("*.py")):
        folder = "/".join(path.relative_to(root).parts[:2]) if path.parent.parent != root else path.parent.name
        lines[folder] = lines.get(folder, 0) + _count([path])
    return lines


def lines_since(revision: str) -> dict[str, int]:
    """Product lines of files that existed at a revision (under any name: git finds renames), and of those added."""
    command = ["git", "diff", "-M", "--diff-filter=A", "--name-only", revision, "--", *PRODUCT]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split()
    added = [ROOT / name for name in names if name.endswith(".py")]
    product = [path for folder in PRODUCT for path in (ROOT / folder).rglob("*.py")]
    return {
        f"product lines, stood at {revision[:12]}": _count(product) - _count(added),
        f"product lines, {len(added)} files added since": _count(added),
    }


def _ends(root: Path) -> tuple[str, str]:
    """The modules that hold ``fit`` and the line that multiplies alpha by transmittance."""
    splatting = next((root / "og_pointcloud").rglob("splatting.py"))
    return "og_pointcloud.fitting.fit", ".".join(splatting.relative_to(root).with_suffix("").parts)


def path_between(edges: dict[str, dict[str, int]], start: str, end: str) -> list[str]:
    """The modules on the shortest import path from one to the other, both included."""
    ways = [[start]]
    seen = {start}
    for way in ways:
        if way[-1] == end:
            return way
        for target in edges.get(way[-1], {}):
            if target not in seen:
                seen.add(target)
                ways.append([*way, target])
    return []


def _functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node


def _lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (function.end_lineno or function.lineno) - function.lineno + 1


def _parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def _count(paths: Iterator[Path] | list[Path]) -> int:
    return sum(len(path.read_text().splitlines()) for path in paths)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # for `| head`, which closes the pipe
    main()
