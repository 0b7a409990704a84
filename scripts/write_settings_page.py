"""docs/settings.md from the settings themselves: name, default, and the docstring below each field.

python scripts/write_settings_page.py          # writes the page; a test holds it against the code
"""

from __future__ import annotations

import ast
import inspect
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path

from og_pointcloud import settings

PAGE = Path(__file__).parents[1] / "docs" / "settings.md"
HEADER = """# Settings

Every number of a fit, with its source or reason. None is a length: distances are in point spacings, weights in pixels,
the rest are shares. The defaults are meant for every scene. In Python,
`FitSettings(mode="grouping", grouping=GroupingSettings(graph_points=20_000))`.
Made by `python scripts/write_settings_page.py`.
"""


def page() -> str:
    """The page's text."""
    kinds = [getattr(settings, name) for name in settings.__all__]
    first = [kind for kind in kinds if kind.__name__ == "FitSettings"]
    return "\n".join([HEADER, *(section(kind) for kind in first + [kind for kind in kinds if kind not in first])])


def section(kind: type) -> str:
    """A class's heading, its docstring, and a line a field."""
    said = docstrings(kind)
    lines = [
        f"## {kind.__name__}",
        "",
        inspect.cleandoc(kind.__doc__ or ""),
        "",
        "| setting | default | |",
        "| --- | --- | --- |",
    ]
    for field in fields(kind):
        default = field.default if field.default is not MISSING else field.default_factory()  # pyright: ignore[reportCallIssue]
        shown = f"`{type(default).__name__}()`" if is_dataclass(default) else f"`{default!r}`"
        lines.append(f"| `{field.name}` | {shown} | {said.get(field.name, '')} |")
    return "\n".join(lines) + "\n"


def docstrings(kind: type) -> dict[str, str]:
    """Field -> the string that stands below it, on one line."""
    body = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(body, ast.ClassDef)
    said = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        is_text = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
            said[field.target.id] = " ".join(str(text.value.value).split()).replace("|", "\\|")  # pyright: ignore
    return said


if __name__ == "__main__":
    PAGE.write_text(page())
    print(f"wrote {PAGE}")
