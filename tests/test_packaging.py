"""What an installation brings: the names that are imported; what it needs."""

import re
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory) -> list[str]:
    builder = pytest.importorskip("hatchling.builders.wheel")
    (wheel,) = builder.WheelBuilder(str(ROOT)).build(
        directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"]
    )
    return zipfile.ZipFile(wheel).namelist()


def test_wheel_has_only_our_top_level_names(wheel_names):
    top_level = {name.split("/")[0] for name in wheel_names}
    assert {"og_pointcloud", "og_pointcloud_export", "og_pointcloud_room"} <= top_level
    strangers = [name for name in top_level if not name.startswith("og_pointcloud")]
    assert strangers == [], "folders of the repository must not become packages"


def test_wheel_has_every_module(wheel_names):
    sources = {"og_pointcloud": ".", "og_pointcloud_export": "export", "og_pointcloud_room": "examples"}
    on_disk = {
        path.relative_to(ROOT / folder).as_posix()
        for package, folder in sources.items()
        for path in (ROOT / folder / package).rglob("*.py")
    } | {path.name for path in (ROOT / "plugins").glob("*.py")}
    assert "og_pointcloud/scene.py" in on_disk
    assert on_disk <= set(wheel_names)
    assert {"og_pointcloud/py.typed", "og_pointcloud/text/everyday_words.txt"} <= set(wheel_names)


def test_the_oldest_packages_that_are_tested_are_those_that_are_promised():
    promised = dict(re.findall(r'"(\w+)>=([\d.]+)"', (ROOT / "pyproject.toml").read_text()))
    tested = dict(re.findall(r'"(\w+)==([\d.]+)\.\*"', (ROOT / "scripts" / "other_pythons.sh").read_text()))
    assert {"numpy", "onnxruntime"} <= tested.keys()
    assert tested.items() <= promised.items()
