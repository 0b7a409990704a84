"""Data flows one way: a folder imports those before it, nothing imports in a circle, hosts stand outside."""

import ast
from pathlib import Path

import pytest
from import_order import FOLDERS, RECORDS, circles, imports_of, upward

ROOT = Path(__file__).parents[1]
HOSTS = ("open3d", "pyvista", "rclpy", "trimesh", "rosbags")


@pytest.fixture(scope="module")
def edges():
    return imports_of(ROOT)


def test_every_import_goes_down(edges):
    assert upward(edges) == []


def test_no_modules_import_each_other(edges):
    assert circles(edges) == []


def test_an_upward_import_and_a_circle_are_found(tmp_path):
    package = tmp_path / "og_pointcloud"
    for folder in ("formats", "ask"):
        (package / folder).mkdir(parents=True)
    (package / "formats/low.py").write_text("def late():\n    import og_pointcloud.ask.high\n")
    (package / "ask/high.py").write_text("from og_pointcloud.formats import low\n")
    edges = imports_of(tmp_path)
    assert upward(edges) == ["og_pointcloud.formats.low:2 imports og_pointcloud.ask.high"]
    assert circles(edges) == [["og_pointcloud.ask.high", "og_pointcloud.formats.low"]]


def test_the_root_holds_the_records_and_nothing_else():
    assert {path.stem for path in (ROOT / "og_pointcloud").glob("*.py")} == {"__init__", "__main__", *RECORDS}
    folders = {path.name for path in (ROOT / "og_pointcloud").iterdir() if any(path.glob("*.py"))}
    assert folders == set(FOLDERS)


def test_the_core_imports_no_host():
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in (ROOT / "og_pointcloud").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if (isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in HOSTS)
        or (isinstance(node, ast.Import) and any(alias.name.split(".")[0] in HOSTS for alias in node.names))
    ]
    assert found == []


def test_onnxruntime_is_imported_in_one_place():
    importers = {
        path.relative_to(ROOT).as_posix()
        for folder in ("og_pointcloud", "export", "plugins")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import) and any(alias.name == "onnxruntime" for alias in node.names)
    }
    assert importers == {"og_pointcloud/models.py"}
