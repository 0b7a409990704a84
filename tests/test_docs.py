"""Documents against the code: commands and options that exist, links, settings, messages, and docstrings' examples."""

import ast
import doctest
import importlib
import inspect
import re
import shlex
import sys
from pathlib import Path

import pytest

import og_pointcloud as og
from og_pointcloud.cli import build_parser
from og_pointcloud.cli.eval_ import capture, scannet
from og_pointcloud.metrics import score_labels
from og_pointcloud.scoring import blocks as spatial_blocks
from og_pointcloud.scoring import instances, lerf, lerf_selection, truth
from og_pointcloud.scoring import scannet as scannet_rules

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = [path for folder in ("og_pointcloud", "export", "plugins") for path in (ROOT / folder).rglob("*.py")]
WITH_EXAMPLES = [path for path in SOURCES if ">>> " in path.read_text()]


@pytest.fixture(scope="module")
def commands():
    action = next(action for action in build_parser()._actions if hasattr(action, "choices") and action.choices)
    return action.choices


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page, commands):
    for line in re.findall(r"og-pointcloud ([a-z][^\n`|#]*)", page.read_text()):
        name, *words = line.split()
        assert name.rstrip(".,:)") in commands, line
        known = commands[name.rstrip(".,:)")]._option_string_actions
        nested = [a.choices for a in commands[name.rstrip(".,:)")]._actions if isinstance(a.choices, dict)]
        for word in words:
            if re.fullmatch(r"\[?--[a-z-]+\]?", word):
                option = word.strip("[]")
                assert option in known or any(
                    option in sub._option_string_actions for n in nested for sub in n.values()
                )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_whole_commands_are_understood(page):
    """Lines of shell blocks: every argument that is needed is there, and every choice is one."""
    for block in blocks(page, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            program, *words = shlex.split(re.sub(r"\[[^\]]*\]", "", line), comments=True) or [""]
            if program == "og-pointcloud":
                assert build_parser().parse_known_args(words)[1] == [], line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_in_pages_is_python_and_imports_what_exists(page):
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("og_pointcloud"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name), f"{node.module}.{alias.name}"
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "og":
                assert hasattr(og, node.attr), f"og.{node.attr}"


def section(page, title):
    """The text between a heading of the second level and the next."""
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", (ROOT / page).read_text(), re.S | re.M).group(1)


def first_cells(text):
    """What the first column of the section's tables has in backquotes."""
    return [name for row in re.findall(r"^\| (`.+?) \|", text, re.M) for name in re.findall(r"`([^`]+)`", row)]


def test_columns_on_the_page_of_scores_are_the_commands_own():
    for title, header, change in (
        ("eval capture", capture.HEADER, ["less the other"]),
        ("eval scannet", scannet.HEADER, []),
    ):
        text = section("docs/scores.md", title)
        assert sorted(first_cells(text)) == sorted([*header[1:], *change])
    assert first_cells(section("docs/scores.md", "eval lerf")) == [*lerf_selection.WAYS, lerf_selection.ORACLE]


def test_rules_on_the_page_of_scores_are_the_codes_own():
    for title, said in {
        "eval capture": (f"fewer than {truth.VOTES}, agree", "fewer than half of the votes", "fewer than 30 counted"),
        "eval scannet": (
            f"opacity below {scannet_rules.OPACITY_COUNTED}",
            f"Tasks of {', '.join(map(str, list(scannet_rules.TASKS)[:2]))} and {list(scannet_rules.TASKS)[2]} classes",
            f"<scene>{scannet.LABELS}",
        ),
        "eval lerf": (f"alpha above {lerf.ALPHA_SHOWN}", f"`over {lerf.IOU_FOUND}`", lerf_selection.LABEL_FOLDER),
        "Intervals": (
            f"{spatial_blocks.SMALLEST_EDGE:g}\npoint spacings",
            f"at least {spatial_blocks.FEWEST_BLOCKS} cubes",
        ),
        "Instances and boxes": (f"fewer than {instances.SMALLEST_INSTANCE} points", f"above\n{instances.MATCHED}"),
    }.items():
        for words in said:
            assert words in section("docs/scores.md", title), words
    assert truth.AGREED == 0.5
    assert inspect.signature(score_labels).parameters["min_points"].default == 30


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_scripts_and_files_named_in_pages_exist(page):
    for name in re.findall(
        r"\b(?:examples|scripts|og_pointcloud|plugins|export|tests)/[\w/.-]*\w\.(?:py|md|txt|yaml)", page.read_text()
    ):
        assert (ROOT / name).exists(), name


def test_settings_page_is_that_of_the_code():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from write_settings_page import PAGE, page
    finally:
        sys.path.pop(0)
    assert PAGE.read_text() == page()


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda path: path.stem)
def test_examples_of_docstrings(path):
    top = next(parent for parent in (ROOT / "export", ROOT / "plugins", ROOT) if parent in path.parents)
    module = importlib.import_module(".".join(path.relative_to(top).with_suffix("").parts))
    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0


def test_messages_on_the_page_of_errors_are_the_codes_own():
    """The first column's quotes, numbers and names aside, are found in the source."""
    source = re.sub(r'"\s*\n\s*f?"', "", "\n".join(path.read_text() for path in SOURCES))
    source = re.sub(r"\{[^{}]*\}", "*", source)
    rows = re.findall(r"^\| (?:left out: )?(`.+?) \|", (ROOT / "docs" / "errors.md").read_text(), re.M)
    quotes = [quote for row in rows for quote in re.findall(r"`([^`]+)`", row)]
    assert len(quotes) >= 7
    for quote in quotes:
        parts = [part.strip() for part in re.split(r"'?\b(?:\d+|N|mug|numba)\b'?|:", quote) if len(part.strip()) > 3]
        assert parts
        for part in parts:
            assert part in source, part
