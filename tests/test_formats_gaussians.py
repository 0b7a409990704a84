"""3DGS PLY files: the trained layout's variants, and the compressed one against a literal decoder."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.gaussian_ply import gaussian_rows
from og_pointcloud.formats.ply import join_columns, read_ply, write_ply
from og_pointcloud.formats.points import read_places, read_points
from og_pointcloud.scene import Points

SPLATS = Path(__file__).resolve().parents[2] / "shared" / "data" / "splats"
INRIA, BIKER = SPLATS / "inria_9k.ply", SPLATS / "biker.compressed.ply"
MAXIMUM_32 = float(np.finfo(np.float32).max)


def trained_columns(n: int = 40) -> dict[str, np.ndarray]:
    """Raw values as a trainer writes them, in Inria's order."""
    random = np.random.default_rng(3)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity", *(f"scale_{i}" for i in range(3))]
    columns = {name: random.normal(size=n).astype("f4") for name in [*names, *(f"rot_{i}" for i in range(4))]}
    return columns | {name: np.zeros(n, "f4") for name in ("nx", "ny", "nz")}


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> Path:
    write_ply(path, {"vertex": join_columns(columns)})
    return path


def assert_same(a: Points, b: Points, atol: float = 0.0) -> None:
    np.testing.assert_allclose(a.xyz_world, b.xyz_world, rtol=0, atol=atol)
    for name in ("scale", "rotation", "opacity"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=max(atol, 1e-7), atol=atol)
    np.testing.assert_array_equal(a.rgb, b.rgb)


def test_activations_are_those_of_3dgs(tmp_path):
    raw = trained_columns()
    points = read_points(write_columns(tmp_path / "a.ply", raw))
    for row in range(len(points)):
        value = {name: float(column[row]) for name, column in raw.items()}
        quaternion = [value[f"rot_{i}"] for i in range(4)]
        length = math.sqrt(sum(q * q for q in quaternion))
        color = [min(max(0.5 + value[f"f_dc_{i}"] / (2 * math.sqrt(math.pi)), 0), 1) * 255 for i in range(3)]
        np.testing.assert_allclose(points.xyz_world[row], [value["x"], value["y"], value["z"]], atol=1e-6)
        np.testing.assert_allclose(points.scale[row], [math.exp(value[f"scale_{i}"]) for i in range(3)], rtol=1e-6)
        np.testing.assert_allclose(points.rotation[row], np.divide(quaternion, length), atol=1e-6)
        np.testing.assert_allclose(points.opacity[row], 1 / (1 + math.exp(-value["opacity"])), atol=1e-6)
        np.testing.assert_allclose(points.rgb[row], color, atol=0.51)


def reversed_order(columns):
    return dict(reversed(columns.items()))


def without_harmonics_and_normals(columns):
    return {name: column for name, column in columns.items() if not name.startswith(("f_rest", "n"))}


def with_instance_features(columns):
    extra = {f"ins_feat_{name}": np.full(len(columns["x"]), np.nan, "f4") for name in ("r", "g", "b", "r2", "g2", "b2")}
    return columns | extra


def as_doubles(columns):
    return {name: column.astype("f8") for name, column in columns.items()}


@pytest.mark.parametrize(
    "variant",
    [reversed_order, without_harmonics_and_normals, with_instance_features, as_doubles],
    ids=lambda v: v.__name__,
)
def test_variants_of_the_trained_layout_read_the_same(tmp_path, variant):
    raw = trained_columns()
    expected = read_points(write_columns(tmp_path / "a.ply", raw))
    assert_same(read_points(write_columns(tmp_path / "b.ply", variant(raw))), expected)


def test_colors_instead_of_harmonics_and_no_color_at_all(tmp_path):
    raw = {name: column for name, column in trained_columns().items() if not name.startswith("f_")}
    assert read_points(write_columns(tmp_path / "a.ply", raw)).rgb is None
    rgb = np.random.default_rng(0).integers(0, 256, (40, 3)).astype("u1")
    raw |= {name: rgb[:, i] for i, name in enumerate(("red", "green", "blue"))}
    np.testing.assert_array_equal(read_points(write_columns(tmp_path / "b.ply", raw)).rgb, rgb)


def test_extreme_but_finite_gaussians_stay_finite(tmp_path):
    raw = trained_columns(6)
    raw["opacity"][:] = [-np.inf, np.inf, -1e30, 1e30, 0, 88]
    raw["scale_0"][:] = [-np.inf, -1e30, -100, 88.7, 0, 1]
    for i in range(4):
        raw[f"rot_{i}"][:3] = [0, 1e-38, 2e38]
    points = read_points(write_columns(tmp_path / "a.ply", raw))
    np.testing.assert_allclose(points.opacity, [0, 1, 0, 1, 0.5, 1], atol=1e-7)
    assert points.scale[:3, 0].tolist() == pytest.approx([0, 0, 0], abs=1e-43)
    assert 3e38 < points.scale[3, 0] <= MAXIMUM_32
    assert points.rotation[0].tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(np.linalg.norm(points.rotation, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("x", np.nan, "position"),
        ("z", np.inf, "position"),
        ("scale_1", 88.8, "scale"),
        ("scale_1", np.nan, "scale"),
        ("rot_2", np.nan, "rotation"),
        ("rot_2", np.inf, "rotation"),
        ("opacity", np.nan, "opacity"),
        ("f_dc_1", np.nan, "color"),
    ],
)
def test_gaussians_that_are_not_finite_are_left_out_and_keep_their_rows_among_places(tmp_path, name, value, part):
    raw = trained_columns()
    whole = read_points(write_columns(tmp_path / "a.ply", raw))
    raw[name][[7, 20]] = value
    path, says = write_columns(tmp_path / "a.ply", raw), f"not finite .the first is row 7, in its {part}.: "
    with pytest.warns(UserWarning, match=f"a.ply: 2 of 40 Gaussians are {says}left out") as caught:
        points = read_points(path)
    assert caught[0].filename == __file__
    assert_same(points, whole.take(np.delete(np.arange(40), [7, 20])), atol=1e-6)
    with pytest.warns(UserWarning, match=f"a.ply: 2 of 40 Gaussians are {says}unknown"):
        places = read_places(path)
    assert np.flatnonzero(np.isnan(places).all(axis=1)).tolist() == [7, 20]
    np.testing.assert_array_equal(np.delete(places, [7, 20], axis=0), points.xyz_world)
    raw[name][:] = value
    with pytest.raises(SceneError, match=f"a.ply: 40 of 40 Gaussians .*row 0, in its {part}.; expected finite values"):
        read_points(write_columns(path, raw))


def test_a_missing_property_is_named(tmp_path):
    raw = trained_columns()
    del raw["scale_2"]
    with pytest.raises(SceneError, match=r"a\.ply: no column scale_2; expected scale_0, scale_1, scale_2"):
        read_points(write_columns(tmp_path / "a.ply", raw))


def test_no_gaussians(tmp_path):
    with pytest.raises(SceneError, match="0 points"):
        read_points(write_columns(tmp_path / "a.ply", trained_columns(0)))


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_what_is_written_reads_back(tmp_path, offset):
    points = read_points(write_columns(tmp_path / "a.ply", trained_columns()))
    moved = Points(points.xyz, points.origin + offset, points.rgb, points.scale, points.rotation, points.opacity)
    write_ply(tmp_path / "b.ply", {"vertex": gaussian_rows(moved)})
    assert_same(read_points(tmp_path / "b.ply"), moved, atol=2e-6)


def test_limits_are_written_as_finite_numbers(tmp_path):
    identity = np.tile(np.float32([1, 0, 0, 0]), (3, 1))
    points = Points.from_world(
        np.eye(3), scale=np.float32([[0, 1, 1e-45], [1, 1, 1], [1e38, 1, 1]]), rotation=identity,
        opacity=np.float32([0, 1, 0.5]),
    )  # fmt: skip
    write_ply(tmp_path / "a.ply", {"vertex": gaussian_rows(points)})
    raw = read_ply(tmp_path / "a.ply")["vertex"]
    assert all(np.isfinite(raw[name]).all() for name in raw.dtype.names)
    read = read_points(tmp_path / "a.ply")
    np.testing.assert_allclose(read.opacity, points.opacity, atol=1e-7)
    np.testing.assert_allclose(read.scale, points.scale, rtol=1e-5, atol=1e-37)
    assert read.rgb.tolist() == [[128, 128, 128]] * 3


def test_plain_points_are_not_written_as_gaussians(tmp_path):
    with pytest.raises(SceneError, match="expected Gaussians"):
        write_ply(tmp_path / "a.ply", {"vertex": gaussian_rows(Points.from_world(np.eye(3)))})


# ---- compressed


CHUNK = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
CHUNK += [name.replace("_", "_scale_") for name in CHUNK]
COLOR_CHUNK = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def decode_literally(elements: dict[str, np.ndarray], row: int) -> dict[str, list[float]]:
    """One splat, written out bit by bit."""
    chunk = elements["chunk"][row // 256]
    position, rotation, scale, color = (int(elements["vertex"][name][row]) for name in PACKED)

    def between(low: str, high: str, share: float) -> float:
        if low not in chunk.dtype.names:
            return share
        return float(chunk[low]) * (1 - share) + float(chunk[high]) * share

    def eleven_ten_eleven(word: int) -> list[float]:
        return [(word >> 21) / 2047, (word >> 11) % 1024 / 1023, word % 2048 / 2047]

    others = [((rotation >> shift) % 1024 / 1023 - 0.5) * math.sqrt(2) for shift in (20, 10, 0)]
    quaternion = list(others)
    quaternion.insert(rotation >> 30, math.sqrt(max(0.0, 1 - sum(q * q for q in others))))
    length = math.sqrt(sum(q * q for q in quaternion))
    red, green, blue, alpha = ((color >> shift) % 256 / 255 for shift in (24, 16, 8, 0))
    rgb = [between(f"min_{c}", f"max_{c}", share) for c, share in zip("rgb", (red, green, blue), strict=True)]
    shares, logs = eleven_ten_eleven(position), eleven_ten_eleven(scale)
    return {
        "xyz": [between(f"min_{c}", f"max_{c}", share) for c, share in zip("xyz", shares, strict=True)],
        "scale": [
            math.exp(between(f"min_scale_{c}", f"max_scale_{c}", share)) for c, share in zip("xyz", logs, strict=True)
        ],
        "rotation": [q / length for q in quaternion],
        "opacity": [alpha],
        "rgb": [min(max(c, 0), 1) * 255 for c in rgb],
    }


def assert_decoded_literally(points: Points, elements: dict[str, np.ndarray], rows: np.ndarray) -> None:
    for row in rows:
        expected = decode_literally(elements, int(row))
        np.testing.assert_allclose(points.xyz_world[row], expected["xyz"], atol=1e-5)
        np.testing.assert_allclose(points.scale[row], expected["scale"], rtol=1e-5)
        np.testing.assert_allclose(points.rotation[row], expected["rotation"], atol=1e-6)
        np.testing.assert_allclose(points.opacity[row], expected["opacity"], atol=1e-6)
        np.testing.assert_allclose(points.rgb[row], expected["rgb"], atol=0.501)


def compressed_elements(n: int, chunk_names: list[str]) -> dict[str, np.ndarray]:
    """Random words: every bit pattern is a valid splat."""
    random = np.random.default_rng(4)
    chunks = -(-n // 256)
    chunk = {name: random.normal(size=chunks).astype("f4") for name in chunk_names}
    for name in chunk_names:
        if name.startswith("max"):
            chunk[name] += 4
    vertex = {name: random.integers(0, 1 << 32, n, dtype="u4") for name in PACKED}
    return {"chunk": join_columns(chunk), "vertex": join_columns(vertex)}


@pytest.mark.parametrize("chunk_names", [CHUNK + COLOR_CHUNK, CHUNK], ids=["color bounds", "no color bounds"])
@pytest.mark.parametrize("n", [1, 256, 700])
def test_compressed_splats_against_the_literal_decoder(tmp_path, n, chunk_names):
    elements = compressed_elements(n, chunk_names)
    write_ply(tmp_path / "a.ply", elements)
    points = read_points(tmp_path / "a.ply")
    assert len(points) == n
    assert_decoded_literally(points, elements, np.arange(n)[:: max(1, n // 200)])


def test_compressed_files_that_do_not_fit(tmp_path):
    elements = compressed_elements(300, CHUNK)
    write_ply(tmp_path / "a.ply", elements | {"chunk": elements["chunk"][:1]})
    with pytest.raises(SceneError, match="300 packed splats in 1 chunks of 256; expected 2"):
        read_points(tmp_path / "a.ply")
    vertex = {name: elements["vertex"][name] for name in PACKED[:3]}
    write_ply(tmp_path / "b.ply", elements | {"vertex": join_columns(vertex)})
    with pytest.raises(SceneError, match="no property 'packed_color' of type uint"):
        read_points(tmp_path / "b.ply")
    signed = {name: elements["vertex"][name].view("i4") for name in PACKED}
    write_ply(tmp_path / "b.ply", elements | {"vertex": join_columns(signed)})
    with pytest.raises(SceneError, match="no property 'packed_position' of type uint"):
        read_points(tmp_path / "b.ply")
    elements["chunk"]["max_y"][1] = np.inf
    write_ply(tmp_path / "c.ply", elements)
    with pytest.warns(UserWarning, match=r"44 of 300 Gaussians are not finite .the first is row 256, in its position"):
        assert len(read_points(tmp_path / "c.ply")) == 256


# ---- .splat


def test_splat_records_against_a_literal_packer(tmp_path):
    points = read_points(write_columns(tmp_path / "a.ply", trained_columns()))
    data = b""
    for row in range(len(points)):
        data += struct.pack("<6f", *points.xyz_world[row], *points.scale[row])
        data += bytes([*points.rgb[row], round(float(points.opacity[row]) * 255)])
        data += bytes(min(round(float(part) * 128 + 128), 255) for part in points.rotation[row])
    (tmp_path / "a.splat").write_bytes(data)
    found = read_points(tmp_path / "a.splat")
    np.testing.assert_allclose(found.xyz_world, points.xyz_world, atol=1e-6)
    np.testing.assert_array_equal(found.scale, points.scale)
    np.testing.assert_array_equal(found.rgb, points.rgb)
    np.testing.assert_allclose(found.opacity, points.opacity, atol=0.5 / 255 + 1e-6)
    assert ((found.rotation * points.rotation).sum(axis=1) > 1 - 1e-4).all()
    (tmp_path / "a.splat").write_bytes(np.random.default_rng(0).bytes(3200))
    with pytest.raises(SceneError, match=r"a\.splat: its quaternions have a median length of .*; expected 1"):
        read_points(tmp_path / "a.splat")
    (tmp_path / "a.splat").write_bytes(data[:-1])
    with pytest.raises(SceneError, match=r"a\.splat: it has 1279 bytes; expected 32 for each splat"):
        read_points(tmp_path / "a.splat")


# ---- files of other programs


@pytest.mark.skipif(not BIKER.is_file(), reason="shared data: splats/biker.compressed.ply")
def test_a_supersplat_file():
    elements = read_ply(BIKER)
    points = read_points(BIKER)
    assert len(points) == len(elements["vertex"]) == 152746
    rows = np.random.default_rng(5).choice(len(points), 300, replace=False)
    assert_decoded_literally(points, elements, rows)
    chunk = elements["chunk"][np.arange(len(points)) // 256]
    for axis, name in enumerate("xyz"):
        assert (points.xyz_world[:, axis] >= chunk[f"min_{name}"] - 1e-6).all()
        assert (points.xyz_world[:, axis] <= chunk[f"max_{name}"] + 1e-6).all()
    assert points.opacity.min() >= 0
    assert points.opacity.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(points.rotation, axis=1), 1, atol=1e-6)


@pytest.mark.skipif(not INRIA.is_file(), reason="shared data: splats/inria_9k.ply")
def test_an_inria_file_survives_the_way_through_our_writer(tmp_path):
    points = read_points(INRIA)
    assert points.are_gaussians
    assert len(points) == 9080
    raw = read_ply(INRIA)["vertex"]
    np.testing.assert_allclose(np.log(points.scale[:, 2]), raw["scale_2"], rtol=1e-5, atol=1e-6)
    write_ply(tmp_path / "a.ply", {"vertex": gaussian_rows(points)})
    read = read_points(tmp_path / "a.ply")
    np.testing.assert_allclose(read.xyz_world, points.xyz_world, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(read.scale, points.scale, rtol=1e-5)
    np.testing.assert_allclose(read.opacity, points.opacity, atol=1e-6)
    np.testing.assert_array_equal(read.rgb, points.rgb)
