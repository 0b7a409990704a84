"""What importing and asking may touch, tried in processes of their own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest

HEAVY = ("torch", "open3d", "pyvista", "vtk", "cv2", "numba", "scipy", "onnx", "trimesh", "laspy", "tqdm")
ASK = """
import sys
import numpy as np
import og_pointcloud as og
scene = og.load(sys.argv[1])
points = scene.xyz + 0.02
result = og.segment(points, ["apple", "pear"], scene)
assert (result.labels >= 0).any()
assert (og.Segmenter(scene, ["plum"])(points).labels >= 0).any()
result.save(sys.argv[2] + "/out.npz"), result.save(sys.argv[2] + "/out.ply")
og.read_points(sys.argv[2] + "/out.ply")
from og_pointcloud_ros import to_detections
message = result.to_pointcloud2()
assert (og.segment(message, ["apple", "pear"], scene).labels == result.labels).mean() > 0.99
assert to_detections(scene, result).detections
camera = og.Camera(64, 48, 40, 40, 32, 24, np.array([[1, 0, 0, -1], [0, 0, -1, 1], [0, 1, 0, 3], [0, 0, 0, 1.0]]))
x, y, z = place = scene.xyz[np.flatnonzero(scene.instance_ids == 5)[0]]
hit = og.pick(scene, camera, (40 * (x - 1) / (y + 3) + 32, 40 * (1 - z) / (y + 3) + 24))
assert og.pick(scene, hit.xyz_world).point == hit.point is not None
hit = og.pick(scene, place)
assert hit.instance == 5 and hit.mask(camera).any() and len(hit.words()) == 5
"""


def run(code, *arguments, **environment):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("start", "heavy"),
    [
        ("import og_pointcloud", {*HEAVY, "numpy", "onnxruntime"}),
        ("from og_pointcloud.cli import main; main(['--help'])", {*HEAVY, "onnxruntime"}),
    ],
)
def test_a_start_brings_nothing_heavy(start, heavy):
    code = f"import sys\ntry:\n    {start}\nexcept SystemExit:\n    pass\nprint('loaded', *sys.modules)"
    loaded = run(code).split("loaded ")[1].split()
    assert "og_pointcloud" in loaded
    assert not heavy & set(loaded)


def test_loading_and_asking_bring_nothing_heavy(bundle, tmp_path):
    loaded = run(ASK + "print(*sys.modules)", bundle, tmp_path).split()
    assert "onnxruntime" in loaded
    assert not set(HEAVY) & set(loaded)


def test_a_cloud_in_memory_is_asked_without_its_exporter(bundle, tmp_path):
    """Nothing heavy, and nothing of what writes files: its arrays answer."""
    blocked = f"import sys; sys.modules.update(dict.fromkeys({(*HEAVY, 'og_pointcloud_export')}))\n"
    in_memory = ASK.replace("og.load(sys.argv[1])", "og.LabelledScene.from_cloud(og.load(sys.argv[1]).cloud)")
    run(blocked + in_memory, bundle, tmp_path)


def test_a_missing_extra_is_named(bundle, tmp_path):
    blocked = """import sys
sys.modules.update(dict.fromkeys(["numba", "open3d", "pyvista", "laspy"]))
import og_pointcloud as og
"""
    tried = """
result = og.segment(og.load(sys.argv[1]))
open(sys.argv[2] + "/a.las", "wb").write(b"LASF")
for ask in (
    lambda: og.write_bundle,
    lambda: result.to_open3d(),
    lambda: result.to_pyvista(),
    lambda: result.save(sys.argv[2] + "/b.laz"),
    lambda: og.segment(sys.argv[2] + "/a.las", scene=sys.argv[1]),
):
    try:
        ask()
    except og.MissingExtraError as error:
        print(error)
"""
    modules = ("numba", "open3d", "pyvista", "laspy", "laspy")
    extras = ("fit", "open3d", "pyvista", "las", "las")
    assert run(blocked + tried, bundle, tmp_path).splitlines() == [
        f"this needs {module}, which is not installed: pip install 'og-pointcloud[{extra}]'"
        for module, extra in zip(modules, extras, strict=True)
    ]


def test_a_module_that_cannot_be_loaded_is_not_said_to_be_absent(tmp_path):
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    code = """import sys
sys.path.insert(0, sys.argv[1])
import og_pointcloud as og
from og_pointcloud.formats.images import require_cv2
try:
    require_cv2()
except og.MissingExtraError as error:
    print(error)
"""
    told = run(code, tmp_path)
    assert "which cannot be loaded (libGL.so.1: cannot open shared object file); remove the cause, or else: pip" in told


@pytest.mark.parametrize("module", ["scipy", "numba"])
def test_what_makes_scenes_names_its_extra(module):
    code = f"""import sys
sys.modules["{module}"] = None
import og_pointcloud as og
for name in ("fit", "Mapper", "compare", "update", "fit_many", "read_opengaussian"):
    try:
        getattr(og, name)
    except og.MissingExtraError as error:
        print(error)
"""
    told = f"this needs {module}, which is not installed: pip install 'og-pointcloud[fit]'"
    assert run(code).splitlines() == [told] * 6


@pytest.mark.parametrize("command", ["fit CAPTURE -o x.ogpc", "compare SCENE SCENE", "report CAPTURE -o report"])
def test_commands_that_make_scenes_name_their_extra(command, bundle, tmp_path):
    words = command.replace("SCENE", str(bundle)).replace("CAPTURE", str(tmp_path)).split()
    code = f"import sys; sys.modules['scipy'] = None\nfrom og_pointcloud.cli import main\nsys.exit(main({words}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 2
    assert "pip install 'og-pointcloud[fit]'" in done.stderr
    assert "report it" not in done.stderr


def test_asking_writes_nothing_into_the_home_folder(bundle, tmp_path):
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    out.mkdir()
    quiet = {"CI", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME"}
    environment = {name: value for name, value in os.environ.items() if name not in quiet}
    command = [sys.executable, "-B", "-c", ASK, str(bundle), str(out)]
    subprocess.run(command, check=True, env=environment | {"HOME": str(home)}, timeout=60)
    assert list(home.rglob("*")) == []


def test_a_users_own_telemetry_choice_stands():
    code = "import og_pointcloud.models, os; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    assert run(code, ORT_DISABLE_TELEMETRY="0").strip() == "0"


def test_every_public_name_resolves_and_is_listed():
    import og_pointcloud as og

    assert set(og.__all__) <= set(dir(og))
    for name in og.__all__:
        home = og._HOME_OF[name]
        if importlib.util.find_spec(home) is not None:
            assert getattr(og, name) is not None
    assert set(og._HOME_OF) == set(og.__all__)
    with pytest.raises(AttributeError, match="no attribute 'segmnet'"):
        og.segmnet  # noqa: B018


def test_fit_stays_the_function_whichever_way_its_module_is_imported():
    code = "import og_pointcloud as og, og_pointcloud.fitting.fit as stages; print(og.fit is stages.fit)"
    assert run(code).strip() == "True"
