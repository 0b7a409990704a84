"""Files from strangers: any bytes, and valid files that are damaged or lie, are read or refused with one error.

Never another exception, a numpy warning, a result that is not finite, or more memory than a small file can need.
Below, by name, files that once got through.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import struct
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from copc_files import attributes_of, write_copc
from hard_cases.inputs import labelled_cloud, scatter, write_two_balls
from hostile_files import SEEDS, UNKNOWN_GRAPHS, with_graph
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some
from test_formats_sog import packed as packed_sog
from test_formats_sog import written as written_sog
from test_formats_spz import splats

from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.cli import main
from og_pointcloud.errors import BundleError, FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.formats import colmap
from og_pointcloud.formats.images import image_size
from og_pointcloud.formats.las import write_las
from og_pointcloud.formats.mask_files import read_ids
from og_pointcloud.formats.nerfstudio import read_transforms
from og_pointcloud.formats.npy import array_from_npy, npy_bytes
from og_pointcloud.formats.photogrammetry import read_photogrammetry
from og_pointcloud.formats.ply import join_columns, write_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.poses import in_pinholes
from og_pointcloud.formats.rgbd import read_rgbd
from og_pointcloud.formats.spz import write_spz
from og_pointcloud.scene import Camera, Points
from og_pointcloud.text.text_features import read_text_features

MOST_BYTES = 1 << 26
"""What reading a file of some kilobytes may take."""
LONGEST_MESSAGE = 600
INTEGERS = (0, 1, 127, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
WORDS = (b"", b"-1", b"1e400", b"nan", b"9" * 25, b"1000000000000", b"\x00", b"list", b"{}", b'"', b"\xff\xfe", b"..")


# Readers, each with valid files -----------------------------------------------------------------------------------


def _xyz(count: int = 12) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


def _npy(folder: Path) -> list[bytes]:
    return [npy_bytes(array) for array in (_xyz(), np.ones((2, 3), np.int16), np.array(["a", "bc"]))]


def _ogpc(folder: Path) -> list[bytes]:
    from og_pointcloud_export import write_bundle

    return [write_bundle(labelled_cloud(count=60), folder / "made.ogpc").read_bytes()]


def _ply(folder: Path) -> list[bytes]:
    xyz = dict(zip("xyz", _xyz().T.astype(np.float32), strict=True))
    write_ply(folder / "made.ply", {"vertex": join_columns({**xyz, "red": np.full(12, 9, np.uint8)})})
    gaussians = scatter()
    names = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "opacity")
    rows = np.c_[gaussians.xyz, np.log(gaussians.scale), gaussians.rotation, gaussians.opacity]
    write_ply(folder / "splats.ply", {"vertex": join_columns(dict(zip(names, rows.T, strict=True)))})
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 1 2\n1e6 2 3\n3 0 1 1\n"
    return [(folder / "made.ply").read_bytes(), (folder / "splats.ply").read_bytes(), header.encode()]


def _pcd(folder: Path) -> list[bytes]:
    header = "VERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U U\nCOUNT 1 1 1 4 1\nWIDTH 12\nHEIGHT 1\n"
    header += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\nDATA "
    rows = [np.float32(point).tobytes() + bytes(4) + struct.pack("<I", 1000) for point in _xyz()]
    text = "".join(f"{x} {y} {z} 0 0 0 0 1000\n" for x, y, z in _xyz())
    columns = [_xyz().astype("<f4").tobytes("F"), bytes(48), struct.pack("<12I", *range(12))]
    data = b"".join(columns)
    packed = b"".join(bytes([len(data[at : at + 32]) - 1]) + data[at : at + 32] for at in range(0, len(data), 32))
    compressed = struct.pack("<II", len(packed), len(data)) + packed  # LZF without a copy
    ends = (b"ascii\n" + text.encode(), b"binary\n" + b"".join(rows), b"binary_compressed\n" + compressed)
    return [header.encode() + end for end in ends]


def _las(folder: Path) -> list[bytes]:
    pytest.importorskip("laspy")
    write_las(folder / "made.las", _xyz(), np.full((12, 3), 99, np.uint8), attributes_of([0] * 12), ("chair",))
    return [(folder / "made.las").read_bytes()]


def _copc(folder: Path) -> list[bytes]:
    pytest.importorskip("laspy")
    write_copc(folder / "made.copc.laz", _xyz(), np.full((12, 3), 99, np.uint8))
    return [(folder / "made.copc.laz").read_bytes()]


def _spz(folder: Path) -> list[bytes]:
    write_spz(folder / "made.spz", splats(12))
    raw = gzip.decompress((folder / "made.spz").read_bytes())
    return [(folder / "made.spz").read_bytes(), gzip.compress(raw, compresslevel=0)]  # of the second, damage is read


def _splat(folder: Path) -> list[bytes]:
    return [b"".join(struct.pack("<6f8B", *xyz, *np.exp(xyz), 9, 8, 7, 255, 200, 230, 128, 128) for xyz in _xyz(11))]


def _sog(folder: Path) -> list[bytes]:
    return [written_sog(folder / "made.sog", *packed_sog(splats(12))).read_bytes()]


def _images_bin(folder: Path) -> list[bytes]:
    image = struct.pack("<I7dI", 1, 1.0, 0, 0, 0, 0.1, 0.2, 0.3, 1) + b"image.png\0" + struct.pack("<Q", 2)
    return [struct.pack("<Q", 1) + image + 2 * struct.pack("<ddq", 1.5, 2.5, -1)]


def _points_bin(folder: Path) -> list[bytes]:
    points = [struct.pack("<Q3d3BdQ", row, *xyz, 9, 8, 7, 0.5, 1) + bytes(8) for row, xyz in enumerate(_xyz())]
    return [struct.pack("<Q", len(points)) + b"".join(points)]


def _transforms(folder: Path) -> list[bytes]:
    write_two_balls(folder / "capture", views=2, points=20)
    content = json.loads((folder / "capture" / "transforms.json").read_text())
    lens = {"camera_model": "OPENCV", "k1": 0.1, "applied_transform": np.eye(4)[:3].tolist()}
    return [json.dumps(made).encode() for made in (content, {**content, **lens})]


def _metashape(folder: Path) -> list[bytes]:
    calibration = '<calibration class="adjusted"><f>70</f><cx>1</cx><k1>0.1</k1><p1>0.01</p1></calibration>'
    pose = " ".join(map(str, np.eye(4).ravel().tolist()))
    placed = "<rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>2.5</scale>"
    parts = [
        '<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors><sensor id="0" type="frame">',
        f'<resolution width="64" height="48"/>{calibration}</sensor></sensors><cameras>',
        f'<camera id="0" sensor_id="0" label="a"><transform>{pose}</transform></camera></cameras>',
        f"<transform>{placed}</transform></chunk></document>",
    ]
    return ["".join(parts).encode(), "".join(parts).replace('"frame"', '"fisheye"').encode()]


def _polycam(folder: Path) -> list[bytes]:
    keys = {"fx": 70.0, "fy": 70.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    keys |= {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    return [json.dumps(keys).encode()]


REALITYSCAN = (
    b"#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\na.jpg,1,2,3,10,20,30,35,0.1,0.2,0.1,0,0,0,0.01,0\n"
)
POSE = np.eye(4).ravel().tolist()
SCANNER_APP = json.dumps({"cameraPoseARFrame": POSE, "intrinsics": [70, 0, 32, 0, 70, 24, 0, 0, 1]}).encode()
TRAJ = b"10.001 0.1 0.2 0.3 1 2 3\n10.1 0 0 0 0 0 0\n"
DRIVE = "2013_05_28_drive_0000_sync"
PERSPECTIVE = b"calib_time: x\nS_rect_00: 64 48\nP_rect_00: 70 0 32 0 0 70 24 0 0 0 1 0\n"
CAM0_TO_WORLD = b"7 0 0 1 100 -1 0 0 200 0 -1 0 1.5 0 0 0 1\n"


def _e57(folder: Path) -> list[bytes]:
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(folder / "made.e57"), mode="w") as file:
        data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), _xyz().T.copy(), strict=True))
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.array([1.0, 2, 3]))
    return [(folder / "made.e57").read_bytes()]


def _read_photogrammetry(path: Path) -> list[np.ndarray]:
    images = read_photogrammetry(path, lambda _: (64, 48)).images
    return [view.camera.world_to_camera for image in images for view in in_pinholes(image)]


def _read_in_layout(place: str, images: dict[str, bytes]) -> Callable[[Path], list[np.ndarray]]:
    """Reads a folder of these images and one file of any content."""

    def read(path: Path) -> list[np.ndarray]:
        folder = path.parent / "capture"
        for name, content in {**images, place: path.read_bytes()}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        frames = read_rgbd(folder)
        return [image.camera.world_to_camera for image in frames.images]

    return read


PICTURE = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()


def _images(folder: Path) -> list[bytes]:
    noise = np.random.default_rng(0).integers(0, 256, (9, 13, 3), np.uint8)
    return [cv2.imencode(ending, noise)[1].tobytes() for ending in (".jpg", ".bmp", ".webp", ".tif", ".png")]


def _words(folder: Path) -> list[bytes]:
    np.savez(folder / "made.npz", names=np.array(["chair", "desk"]), vectors=np.eye(2), feature_space=np.array("fuzz"))
    return [(folder / "made.npz").read_bytes()]


def _read_npy(path: Path) -> list[np.ndarray]:
    try:
        array_from_npy(path.read_bytes())  # may hold anything
    except ValueError as error:  # whoever calls it names the file
        raise OgPointcloudError(str(error)) from error
    return []


def _read_images_bin(path: Path) -> list[np.ndarray]:
    (path.parent / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 48, 36, 70.0, 72.0, 24.0, 18.0))
    return [image.camera.world_to_camera for image in colmap.read_images(path.parent)]


def _read_ogpc(path: Path) -> list[np.ndarray]:
    cloud = read_bundle(path).cloud
    assert cloud.instance_ids.max(initial=-1) < len(cloud.instances)
    return [cloud.xyz, cloud.instances.descriptors]


def _read_transforms(path: Path) -> list[np.ndarray]:
    images = read_transforms(path, lambda _: (48, 36)).images
    return [view.camera.world_to_camera for image in images for view in in_pinholes(image)]


LEFT_IMAGE = {f"data_2d_raw/{DRIVE}/image_00/data_rect/0000000007.png": PICTURE}
POSES_FILE, CALIBRATION_FILE = f"data_poses/{DRIVE}/cam0_to_world.txt", "calibration/perspective.txt"
ARKIT = {"lowres_wide/1_10.001.png": PICTURE, "lowres_wide_intrinsics/1_10.001.pincam": b"64 48 70 70 32 24"}
READERS: dict[str, tuple[Callable | bytes, Callable]] = {
    "array.npy": (_npy, _read_npy),
    "scene.ogpc": (_ogpc, _read_ogpc),
    "cloud.ply": (_ply, lambda path: [read_points(path).xyz]),
    "cloud.pcd": (_pcd, lambda path: [read_points(path).xyz]),
    "splats.spz": (_spz, lambda path: [read_points(path).xyz]),
    "splats.sog": (_sog, lambda path: [read_points(path).xyz]),
    "splats.splat": (_splat, lambda path: [read_points(path).xyz]),
    "cloud.csv": (b"x,y,z,r,g,b,name\n1,2,3,4,5,6,a\n7.5,-8,9e1,4,5,6,b\n", lambda path: [read_points(path).xyz]),
    "cloud.pts": (b"2\n1 2 3 -10 4 5 6\n4 5 6 90 255 0 9\n", lambda path: [read_points(path).xyz]),
    "cloud.las": (_las, lambda path: [read_points(path).xyz]),
    "cloud.copc.laz": (_copc, lambda path: [read_points(path).xyz]),
    "images.bin": (_images_bin, _read_images_bin),
    "points3D.bin": (_points_bin, lambda path: [Points.from_world(colmap.read_points3d(path.parent)[0]).xyz]),
    "transforms.json": (_transforms, _read_transforms),
    "metashape.xml": (_metashape, _read_photogrammetry),
    "realityscan.csv": (REALITYSCAN, _read_photogrammetry),
    "polycam.json": (_polycam, _read_in_layout("keyframes/cameras/1.json", {"keyframes/images/1.png": PICTURE})),
    "scanner_app.json": (
        SCANNER_APP,
        _read_in_layout("frame_00001.json", {"frame_00001.jpg": PICTURE}),
    ),
    "lowres_wide.traj": (TRAJ, _read_in_layout("lowres_wide.traj", ARKIT)),
    "perspective.txt": (PERSPECTIVE, _read_in_layout(CALIBRATION_FILE, LEFT_IMAGE | {POSES_FILE: CAM0_TO_WORLD})),
    "cam0_to_world.txt": (CAM0_TO_WORLD, _read_in_layout(POSES_FILE, LEFT_IMAGE | {CALIBRATION_FILE: PERSPECTIVE})),
    "scan.e57": (_e57, lambda path: [read_points(path).xyz]),
    "image.jpg": (_images, lambda path: [np.array(image_size(path))]),
    "words.npz": (_words, lambda path: [read_text_features(path)[0].vectors]),
}
"""By the file's name: a valid one or what makes some, and what reads one and returns arrays that must be finite."""


@lru_cache
def valid_files(name: str, folder: Path) -> list[bytes]:
    (folder / name).mkdir()
    made = READERS[name][0]
    return [made] if isinstance(made, bytes) else made(folder / name)


@lru_cache
def first_files(name: str, folder: Path) -> list[bytes]:
    """What damage starts from: valid files, and those that were made by hand to do harm."""
    valid, made = valid_files(name, folder), SEEDS.get(name, [])
    if name == "scene.ogpc":
        source = folder / name / "made.ogpc"
        made = [with_graph(source, folder / "hostile.ogpc", change).read_bytes() for change in UNKNOWN_GRAPHS]
    return valid + made


DOCUMENTED = {
    "PLY": ["cloud.ply"], "PCD": ["cloud.pcd"], "E57": ["scan.e57"], "SPZ": ["splats.spz"], "SOG": ["splats.sog"],
    "`.splat`": ["splats.splat"], "text": ["cloud.pts"],
    "LAS, LAZ, COPC": ["cloud.las", "cloud.copc.laz"], "COLMAP's `.bin`": ["images.bin", "points3D.bin"],
    "nerfstudio's, Polycam's, 3D Scanner App's JSON": ["transforms.json", "polycam.json", "scanner_app.json"],
    "ARKitScenes' `.traj`, KITTI-360's poses": ["lowres_wide.traj", "cam0_to_world.txt"],
    "KITTI-360's calibration": ["perspective.txt"], "Metashape's `.xml`": ["metashape.xml"],
    "RealityScan's `.csv`": ["realityscan.csv"], "`.ogpc`": ["scene.ogpc"], "`text_features.npz`": ["words.npz"],
}  # fmt: skip
"""Rows of the table in docs/errors.md -> READERS."""


def documented_messages() -> list[tuple[str, str, str]]:
    """(reader, damage, message) of each cell of that table; "the same": as in the row above."""
    page = (Path(__file__).parents[1] / "docs" / "errors.md").read_text()
    found, above = [], [""] * 3
    for line in page[page.index("| file | cut in the middle") :].split("\n\n")[0].splitlines()[2:]:
        file, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        of_row = {"the same": above, "as when empty": cells[1:2] * 3, "as when cut": cells[:1] * 3}
        above = [of_row[cell][column] if cell in of_row else cell for column, cell in enumerate(cells)]
        damages = zip(("cut", "empty", "foreign"), (cell.split("`")[1] for cell in above), strict=True)
        found += [(name, *damage) for damage in damages for name in DOCUMENTED[file]]
    return found


@pytest.mark.parametrize(("name", "damage", "says"), documented_messages())
def test_damaged_files_get_the_message_of_the_docs(name: str, damage: str, says: str, folder: Path, tmp_path: Path):
    valid = valid_files(name, folder)[0]
    data = {"cut": valid[: len(valid) // 2], "empty": b"", "foreign": PICTURE}[damage]
    heard = read_or_refused(name, tmp_path / name, data)
    pattern = re.sub(r"\d+", r"\\d+", ".*".join(map(re.escape, says.split("..."))))  # sizes are of the file made here
    assert re.search(pattern, heard, re.DOTALL), heard


@pytest.mark.parametrize("name", [*SEEDS, "scene.ogpc"])
def test_files_made_by_hand_are_read_or_refused(name: str, folder: Path, tmp_path: Path):
    for data in first_files(name, folder):
        read_or_refused(name, tmp_path / name, data)


def read_or_refused(name: str, path: Path, data: bytes) -> str:
    """What the reader says against the file, "" where it is read. Fails for everything that must not happen."""
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            assert all(np.isfinite(array).all() for array in READERS[name][1](path))
        message = ""
    except OgPointcloudError as error:
        message = str(error)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MOST_BYTES
    assert message.isprintable()
    assert len(message) < LONGEST_MESSAGE + len(str(path))
    return message


# Any bytes, and damage --------------------------------------------------------------------------------------------


@some.composite
def damages(draw: some.DrawFn) -> list[tuple[str, float, bytes]]:
    """Changes of a file: what, where (a share of its length), and the bytes to write."""
    written = some.one_of(
        some.binary(min_size=1, max_size=8),
        some.sampled_from(WORDS),
        some.builds(lambda n, size: n.to_bytes(8, "little")[:size], some.sampled_from(INTEGERS), some.integers(1, 8)),
    )
    kinds = some.sampled_from(("write", "write", "insert", "cut", "end", "number", "number"))
    return draw(some.lists(some.tuples(kinds, some.floats(0, 1), written), min_size=1, max_size=3))


def damaged(data: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    """A file after these changes; "number" replaces the number in its text that lies nearest behind the place."""
    for kind, share, written in changes:
        at = int(share * len(data))
        if kind == "number" and (found := re.compile(rb"-?\d[\d.e+-]*").search(data, at)):
            data = data[: found.start()] + written + data[found.end() :]
        elif kind in ("write", "number"):
            data = data[:at] + written + data[at + len(written) :]
        else:
            data = data[:at] + {"insert": written + data[at:], "cut": data[at + 8 :], "end": b""}.get(kind, b"")
    return data


def damaged_member(data: bytes, member: float, changes: list[tuple[str, float, bytes]]) -> bytes:
    """A .ogpc with one file in it damaged and the manifest's checksums made right again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(files)[int(member * (len(files) - 1))]
    files[name] = damaged(files[name], changes)
    if name != "manifest.json":
        manifest = json.loads(files["manifest.json"])
        sums = {"crc32": zlib.crc32(files[name]), "sha256": hashlib.sha256(files[name]).hexdigest()}
        manifest["members"][name] |= {"bytes": len(files[name]), **sums}
        files["manifest.json"] = json.dumps(manifest).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def fuzzed(examples: int, **arguments: some.SearchStrategy) -> Callable[[Callable[..., None]], None]:
    """Run a function of these arguments with so many examples, the same every time."""
    rules = settings(
        max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )
    return lambda check: rules(given(**arguments)(check))()


EXAMPLES = [30, pytest.param(300, marks=[pytest.mark.slow, pytest.mark.release])]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(name: str, folder: Path, tmp_path: Path):
    for data in valid_files(name, folder):
        assert read_or_refused(name, tmp_path / name, data) == ""


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("name", READERS)
def test_any_bytes_are_read_or_refused(name: str, examples: int, folder: Path):
    valid = valid_files(name, folder)[0]

    @fuzzed(examples, data=some.binary(max_size=300), start=some.integers(0, 60))
    def check(data: bytes, start: int) -> None:
        read_or_refused(name, folder / name / name, valid[:start] + data)


@pytest.mark.parametrize("examples", EXAMPLES)
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name: str, examples: int, folder: Path):
    made = first_files(name, folder)

    @fuzzed(examples, which=some.integers(0, 19), member=some.floats(0, 1), changes=damages())
    def check(which: int, member: float, changes: list[tuple[str, float, bytes]]) -> None:
        data = made[which % len(made)]
        changed = damaged_member(data, member, changes) if name.endswith(".ogpc") and which else damaged(data, changes)
        read_or_refused(name, folder / name / name, changed)


def test_what_must_not_happen_fails_the_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def outcome(read: Callable[[Path], object]) -> str:
        monkeypatch.setitem(READERS, "cloud.ply", (_ply, read))
        return read_or_refused("cloud.ply", tmp_path / "cloud.ply", b"x")

    def fail(error: Exception):
        raise error

    assert outcome(lambda _: []) == ""
    assert outcome(lambda _: fail(SceneError("no"))) == "no"
    for error in (KeyError("x"), MemoryError(), RecursionError(), OSError("x"), ZeroDivisionError()):
        with pytest.raises(type(error)):
            outcome(lambda _, error=error: fail(error))
    with pytest.raises(RuntimeWarning):
        outcome(lambda _: [np.float32(3e38) * np.float32(3e38)])
    for wrong in (lambda _: [np.nan], lambda _: [np.zeros(1 << 24)], lambda _: fail(SceneError("x" * 5000))):
        with pytest.raises(AssertionError):
            outcome(wrong)


# What once got through --------------------------------------------------------------------------------------------


def test_messages_are_printable_whatever_the_file_says(capsys, tmp_path):
    error = SceneError("a\x1b[31m b\ud800\r\n\u202e café \U0001f44d")
    assert str(error) == "a\\x1b[31m b\\ud800\\r\\n\\u202e café \U0001f44d"
    (tmp_path / "\x1b[2J.ogpc").write_bytes(b"")
    assert main(["info", str(tmp_path / "\x1b[2J.ogpc")]) != 0
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (9999999999999999999999,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1, " * 5000 + "), }",
        "x" * 5000,
        "{'descr': '<f4)', 'fortran_order': False, 'shape': (3, 4)), }",
        "{'descr': '|S0', 'fortran_order': False, 'shape': (-1,), }",  # numpy.load divides by it
        "{'descr': '|S0', 'fortran_order': False, 'shape': (1000000000000,), }",
    ],
)
def test_array_headers(header):
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(12)
    with pytest.raises(ValueError, match="header") as caught:
        array_from_npy(data)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 200


def test_bytes_behind_an_array():
    with pytest.raises(ValueError, match="claims float64"):
        array_from_npy(npy_bytes(_xyz()) + b"\0")


def test_text_of_characters_that_there_are_not():
    """A str made of them breaks the interpreter."""
    data = npy_bytes(np.array(["chair"]))
    assert array_from_npy(data[:-4] + b"\xff\xff\x10\0")[0] == "chai\U0010ffff"
    for last in (b"\0\0\x11\0", b"\xff\xff\xff\xff"):
        with pytest.raises(ValueError, match="characters that do not exist"):
            array_from_npy(data[:-4] + last)


@pytest.mark.parametrize("value", [10**400, -(10**400), 1e400, float("nan"), "y" * 3000, True, []])
def test_numbers_of_a_pose_file(folder, tmp_path, value):
    content = {**json.loads(valid_files("transforms.json", folder)[0]), "fl_x": value}
    said = read_or_refused("transforms.json", tmp_path / "transforms.json", json.dumps(content).encode())
    assert re.search(r"fl_x is .*; expected a finite number", said)


def test_a_pose_that_overflows_is_refused():
    pose = np.eye(4)
    pose[:3, :3] = [[1e200, -1e200, 0], [1e200, 1e200, 0], [0, 0, 1]]  # its product with itself is inf - inf
    with pytest.raises(SceneError, match="rigid right-handed pose"):
        Camera(4, 4, 1.0, 1.0, 2.0, 2.0, pose)


def test_a_scene_file_that_is_encrypted(folder, tmp_path):
    data = bytearray(valid_files("scene.ogpc", folder)[0])
    data[data.find(b"PK\x01\x02") + 8] |= 1
    assert read_or_refused("scene.ogpc", tmp_path / "scene.ogpc", bytes(data))


def test_long_names_do_not_make_long_messages(folder, tmp_path):
    for name in ("z" * 3000, "\x1b" * 3000):
        path = tmp_path / "scene.ogpc"
        path.write_bytes(valid_files("scene.ogpc", folder)[0])
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(name, b"")
        with pytest.raises(BundleError) as caught:
            read_bundle(path)
        assert len(str(caught.value)) < LONGEST_MESSAGE + len(str(path))


@pytest.mark.parametrize("kind", [b"IDAT", b"tEXt"])
def test_a_chunk_of_a_png_that_claims_more_than_the_file(tmp_path, kind):
    """OpenCV would allocate and fill what it claims: a gigabyte for a hundred bytes."""
    data = PICTURE[:33] + struct.pack(">I", 1 << 30) + kind + PICTURE[33:]
    (tmp_path / "mask.png").write_bytes(data)
    with pytest.raises(SceneError, match=rf"mask.png .*a chunk of 1073741824 bytes has {len(data) - 41} left"):
        read_ids(tmp_path / "mask.png")


@pytest.mark.parametrize(
    ("place", "number", "says"),
    [
        (10, struct.pack("<H", 14), "compressed by method 14"),
        (20, struct.pack("<I", 2**30 - 999), "claims 1073740825 bytes"),
    ],
)
def test_members_of_an_npz_that_numpy_would_not_write(tmp_path, place, number, says):
    stream = io.BytesIO()
    np.savez(stream, names=np.array(["chair"]), vectors=_xyz(1), feature_space=np.array("fuzz"))
    data = bytearray(stream.getvalue())
    directory = data.find(b"PK\x01\x02")
    data[directory + place : directory + place + len(number)] = number
    (tmp_path / "words.npz").write_bytes(data)
    with pytest.raises(FeatureSpaceError, match=says):
        read_text_features(tmp_path / "words.npz")
