"""Documents against the code: commands and options that exist, links, settings, messages, and docstrings' examples."""

import ast
import doctest
import importlib
import json
import re
import shlex
import zipfile
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import instance_table, make_cloud

import og_pointcloud as og
from og_pointcloud.ask import hosts as clouds
from og_pointcloud.ask.hosts import world_points
from og_pointcloud.bundle.format import SCHEMA_VERSION
from og_pointcloud.cli import build_parser, main
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.errors import SceneError
from og_pointcloud.formats import rgbd
from og_pointcloud.text.encoder import DEMO_ENCODER, read_text_encoder

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = [path for folder in ("og_pointcloud", "export", "plugins") for path in (ROOT / folder).rglob("*.py")]


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


def test_figures_of_the_readme_are_those_of_the_pages_it_links():
    """Every row: one row of results.md or scores.md has its mIoU, baseline, background and seconds."""
    section = (ROOT / "README.md").read_text().split("## How good")[1].split("\n## ")[0]
    pages = "".join((ROOT / "docs" / name).read_text() for name in ("results.md", "scores.md"))
    measured = [set(_numbers(line)) for line in pages.splitlines() if line.startswith("|")]
    rows = [row.strip("|").split("|")[1:5] for row in section.splitlines() if re.match(r"\| .*\d\.\d", row)]
    assert len(rows) >= 5
    for miou, baseline, background, seconds in rows:
        figures = {*_numbers(miou), *_numbers(baseline), *_numbers(seconds)}
        shares = {*_numbers(background), *(f"{float(percent) / 100:.3f}" for percent in _numbers(background))}
        assert len(figures) >= 3, (miou, baseline, seconds)
        assert any(figures <= row and (not shares or shares & row) for row in measured), (miou, baseline, seconds)


def _numbers(text):
    return re.findall(r"\d+(?:\.\d+)?", text)


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


def test_the_six_lines_of_the_readme(tmp_path, monkeypatch):
    """They run, and each expression of them has a value."""
    monkeypatch.chdir(tmp_path)
    cloud = make_cloud([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 2], words=("chair", "table", "red mug"))
    og.write_bundle(cloud, "kitchen.ogpc")
    (block, *_), names = blocks(ROOT / "README.md", "python"), {"pcd": cloud.xyz_world}
    for statement in ast.parse(block).body:
        code = ast.get_source_segment(block, statement)
        assert code is not None
        if isinstance(statement, ast.Expr):
            value = eval(code, names)
            assert all(one is not None for one in (value if isinstance(value, tuple) else (value,))), code
        else:
            exec(code, names)


def section(page, title):
    """The text between a heading of the second level and the next."""
    return re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", (ROOT / page).read_text(), re.S | re.M).group(1)


def first_cells(text):
    """What the first column of the section's tables has in backquotes."""
    return [name for row in re.findall(r"^\| (`.+?) \|", text, re.M) for name in re.findall(r"`([^`]+)`", row)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_scripts_and_files_named_in_pages_exist(page):
    for name in re.findall(
        r"\b(?:examples|scripts|og_pointcloud|plugins|export|tests)/[\w/.-]*\w\.(?:py|md|txt|yaml)", page.read_text()
    ):
        assert (ROOT / name).exists(), name


def extending(title):
    """The first block of Python below a heading of docs/extending.md."""
    text = section("docs/extending.md", title) if title else (ROOT / "docs/extending.md").read_text()
    return re.search(r"```python\n(.*?)```", text, re.S).group(1)


def test_a_scene_of_ones_own_arrays(tiny_capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known = og.read_capture(tiny_capture.folder)
    camera = known.views[0].camera
    frames = []
    for view in known.views:
        to_local = np.eye(4)
        to_local[:3, 3] = -known.points.origin
        pose = view.camera.world_to_camera @ to_local
        frames.append((view.name, pose, view.mask_map(), view.mask_features, view.image()))
    names = {"xyz": known.points.xyz_world, "rgb": known.points.rgb, "frames": frames}
    exec(extending(""), names | {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")})
    found = og.load("mine.ogpc")
    assert found.cloud.feature_space == "openai/clip-vit-base-patch16"
    np.testing.assert_array_equal(found.instance_ids, og.fit(known, progress=False).instance_ids)


def test_a_format_of_ones_own(tiny_capture, monkeypatch):
    """The tiny capture's poses as rows of numbers are read as its transforms.json is."""
    names = {}
    exec(extending("A format"), names)
    monkeypatch.setattr(rgbd, "LAYOUTS", ((names["holds_rows"], names["read_rows"]),))
    folder, known = tiny_capture.folder, og.read_capture(tiny_capture.folder)
    (folder / "transforms.json").unlink()
    rows = []
    for view in known.views:
        rotation, translation = view.camera.world_to_camera[:3, :3], view.camera.world_to_camera[:3, 3]
        rows.append(np.column_stack([rotation.T, -rotation.T @ translation + known.points.origin]).ravel())
    np.savetxt(folder / "poses.txt", rows, fmt="%.17g")
    camera = known.views[0].camera
    numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    np.savetxt(folder / "intrinsics.txt", [numbers], fmt="%.17g")
    for view, same in zip(og.read_capture(folder).views, known.views, strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, same.camera.world_to_camera, atol=1e-12)
        assert (view.name, view.camera.fx, view.camera.cx) == (same.name, same.camera.fx, same.camera.cx)
    (folder / "images" / "view0.png").unlink()
    with pytest.raises(SceneError, match="has 5 images and 6 poses"):
        og.read_capture(folder)


def test_a_proposer_of_ones_own(tiny_capture, monkeypatch, capsys):
    """The balls are vivid, floor and sky are not: the masks are those of the capture."""
    folder = tiny_capture.folder.rename(tiny_capture.folder.with_name("kitchen"))
    known = {view.name: view.mask_map() >= 0 for view in og.read_capture(folder).views}
    monkeypatch.chdir(folder.parent)
    (folder.parent / "my_masks.py").write_text(extending("A mask proposer"))
    command = re.search(r"```bash\nog-pointcloud (.*?)\n", section("docs/extending.md", "A mask proposer")).group(1)
    words = command.replace("openai/clip-vit-base-patch16", "none").split()
    assert main([*words, "--overwrite"]) == 0, capsys.readouterr().err
    for view in og.read_capture(folder).views:
        np.testing.assert_array_equal(view.mask_map() >= 0, known[view.name])


def test_a_host_of_ones_own(monkeypatch):
    class Cloud:
        vertices = np.array([[1.0, 2, 3], [4, 5, 6]])

    Cloud.__module__ = "somelibrary.geometry"
    name, reader = re.search(
        r'`"(trimesh)": (lambda geometry: [\w.]+)`', section("docs/extending.md", "A host")
    ).groups()
    with pytest.raises(SceneError):
        world_points(Cloud())
    monkeypatch.setitem(clouds._READERS, "somelibrary", eval(reader))
    np.testing.assert_array_equal(world_points(Cloud()), Cloud.vertices)
    assert name in clouds._READERS


def test_members_of_a_file_are_on_the_page_of_formats(tmp_path):
    """Of a file that has everything a file may have."""
    encoder = read_text_encoder(DEMO_ENCODER / "text")
    texts = encoder(["chair", "table"])
    none = np.full(2, -1, np.int32)
    cloud = replace(
        make_cloud([[0, 0, 0], [1, 0, 0]], [0, 1], words=()),
        instances=replace(instance_table(2), descriptors=texts, coarse=none, part_of=none),
        feature_space=encoder.feature_space,
        certainty=np.full(2, 9, np.uint8),
        cameras=(og.Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4)),),
        vocabulary=Vocabulary(("chair", "table"), texts),
        word_bank=encoder.word_bank,
    )
    path = og.write_bundle(cloud, tmp_path / "s.ogpc", text_encoder=DEMO_ENCODER / "text")
    with zipfile.ZipFile(path) as archive:
        names, manifest = archive.namelist(), json.loads(archive.read("manifest.json"))
    text = section("docs/formats.md", "The `.ogpc` file")
    patterns = first_cells(text)
    assert all(any(fnmatch(name, pattern) for pattern in patterns) for name in names), names
    assert all(any(fnmatch(name, pattern) for name in names) for pattern in patterns), patterns
    fields = next(row for row in text.splitlines() if row.startswith("| `manifest.json`"))
    assert set(manifest) - set(re.findall(r"`(\w+)`", fields)) == set()
    assert f"Schema {SCHEMA_VERSION}." in text


def test_the_session_in_python(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    result = doctest.testfile(str(ROOT / "docs/python.md"), module_relative=False, optionflags=options)
    assert result.attempted > 20
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
