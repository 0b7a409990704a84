"""SPZ: each version against a literal packer, a file of SuperSplat's against its PLY, and files that lie."""

from __future__ import annotations

import gzip
import math
import struct
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.spz import write_spz
from og_pointcloud.scene import Points

SPLATS = Path(__file__).resolve().parents[2] / "shared" / "data" / "splats"


def splats(count=60, center=(0.0, 0.0, 0.0), size=1.0, seed=0):
    random = np.random.default_rng(seed)
    rotation = random.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Points.from_world(
        random.normal(center, size, (count, 3)), rgb=random.integers(0, 256, (count, 3)).astype(np.uint8),
        scale=np.exp(random.uniform(-6, 1, (count, 3))).astype(np.float32), rotation=rotation.astype(np.float32),
        opacity=random.uniform(0, 1, count).astype(np.float32),
    )  # fmt: skip


def header(version, count, degree=0, bits=12, last=0):
    return struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, 0, last)


def columns(points, version):
    """Splat by splat, as the format's text has it; axes right, up, back."""
    positions, alphas, colors, scales, rotations = (bytearray() for _ in range(5))
    for row in range(len(points)):
        x, y, z = points.xyz_world[row]
        for value in (x, -y, -z):
            positions += (round(value * 4096) & 0xFFFFFF).to_bytes(3, "little")
        alphas.append(round(float(points.opacity[row]) * 255))
        for value in points.rgb[row]:
            dc = (value / 255 - 0.5) * 2 * math.sqrt(math.pi)
            colors.append(round((dc * 0.15 + 0.5) * 255))
        scales += bytes(round((math.log(value) + 10) * 16) for value in points.scale[row])
        w, x, y, z = points.rotation[row].tolist()
        rotations += three_bytes(w, x, -y, -z) if version == 2 else smallest_three([x, -y, -z, w])
    return [bytes(column) for column in (positions, alphas, colors, scales, rotations)]


def three_bytes(w, x, y, z):
    sign = -1 if w < 0 else 1
    return bytes(round((sign * value + 1) * 127.5) for value in (x, y, z))


def smallest_three(xyzw):
    largest = max(range(4), key=lambda part: abs(xyzw[part]))
    sign = -1 if xyzw[largest] < 0 else 1
    word = largest
    for part in range(4):
        if part != largest:
            value = sign * xyzw[part]
            word = word << 10 | (512 if value < 0 else 0) | round(abs(value) * math.sqrt(2) * 511)
    return word.to_bytes(4, "little")


def packed(points, version):
    parts = columns(points, version)
    if version < 4:
        return gzip.compress(header(version, len(points)) + b"".join(parts), mtime=0)
    zstandard = pytest.importorskip("zstandard")
    frames = [zstandard.ZstdCompressor().compress(part) for part in parts]
    sizes = b"".join(struct.pack("<QQ", len(f), len(p)) for f, p in zip(frames, parts, strict=True))
    return header(4, len(points), last=5) + struct.pack("<I12x", 32) + sizes + b"".join(frames)


def assert_close(found, points, turn, step=0.5 / 4096):
    assert np.abs(found.xyz_world - points.xyz_world).max() <= step * 1.001
    assert np.abs(np.log(found.scale / points.scale)).max() <= 0.5 / 16 + 1e-5
    assert np.abs(found.opacity - points.opacity).max() <= 0.5 / 255 + 1e-6
    assert np.abs(found.rgb.astype(int) - points.rgb).max() <= 2
    alike = np.abs((found.rotation.astype(np.float64) * points.rotation).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(alike, 1))).max() < turn


@pytest.mark.parametrize("version", [2, 3, 4])
def test_each_version_against_a_literal_packer(tmp_path, version):
    points = splats()
    (tmp_path / "a.spz").write_bytes(packed(points, version))
    # Degrees. Of version 2, w is what the others leave: near half a turn little, and that is lost.
    assert_close(read_points(tmp_path / "a.spz"), points, turn=12 if version == 2 else 0.4)


@pytest.mark.parametrize(("center", "size"), [((0, 0, 0), 1.0), ((3.0, -2.0, 500.0), 9.0), ((0, 0, 0), 3e4)])
def test_what_is_written_is_read(tmp_path, center, size):
    points = splats(center=center, size=size)
    write_spz(tmp_path / "a.spz", points)
    write_spz(tmp_path / "b.spz", points)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    farthest = np.abs(points.xyz_world).max()
    assert_close(read_points(tmp_path / "a.spz"), points, turn=0.4, step=farthest / 2**22 / 2)
    again = read_points(tmp_path / "a.spz")
    write_spz(tmp_path / "c.spz", again)
    assert_close(read_points(tmp_path / "c.spz"), again, turn=0.1, step=1e-9 * size)


def test_the_format_rounds_as_the_literal_packer_does(tmp_path):
    points = splats(center=(100, 300, 0))  # so far that 12 bits are all there is room for: 512 <= farthest * 2 < 2048
    points = Points.from_world(points.xyz_world * 4, rgb=points.rgb, scale=points.scale, rotation=points.rotation,
                               opacity=points.opacity)  # fmt: skip
    write_spz(tmp_path / "a.spz", points)
    assert gzip.decompress((tmp_path / "a.spz").read_bytes()) == gzip.decompress(packed(points, 3))


def test_supersplats_file_is_the_ply_that_it_was_made_of():
    if not SPLATS.is_dir():
        pytest.skip("shared data: splats")
    pytest.importorskip("zstandard")
    spz, ply = read_points(SPLATS / "biker.spz"), read_points(SPLATS / "biker.compressed.ply")
    assert len(spz) == len(ply)
    assert np.abs(spz.xyz_world - ply.xyz_world).max() < 5e-4
    assert np.abs((spz.rotation * ply.rotation).sum(axis=1)).min() > 0.999
    assert np.abs(np.log(spz.scale / np.maximum(ply.scale, np.exp(-10)))).max() < 0.05
    np.testing.assert_allclose(spz.opacity, ply.opacity, atol=1e-6)
    assert np.abs(spz.rgb.astype(int) - ply.rgb).max() <= 2


def test_extreme_splats_survive(tmp_path):
    points = splats()
    flat = Points.from_world(
        points.xyz_world, rgb=None, scale=np.zeros_like(points.scale), rotation=points.rotation,
        opacity=np.ones_like(points.opacity),
    )  # fmt: skip
    with pytest.warns(UserWarning, match=r"a\.spz: 60 of 60 Gaussians have scales that SPZ cannot hold") as caught:
        write_spz(tmp_path / "a.spz", flat)
    assert caught[0].filename == __file__
    found = read_points(tmp_path / "a.spz")
    assert (found.opacity == 1).all()
    assert found.scale.max() < 1e-4
    assert np.abs(found.rgb.astype(int) - 128).max() <= 1


@pytest.mark.parametrize(("scale", "held"), [((400, 1, 1), False), ((370, 0, 1e-9), True), ((4e-5, 0, 0), False)])
def test_scales_that_the_format_cannot_hold_are_told(tmp_path, scale, held):
    points = splats(9)
    points.scale[4] = scale
    with warnings.catch_warnings(record=True) as caught:
        write_spz(tmp_path / "a.spz", points)
    assert [str(warning.message).partition(" Gaussians")[0][-6:] for warning in caught] == ([] if held else ["1 of 9"])


@pytest.mark.parametrize(("center", "size"), [((1e6, 2e6, 0), 3.0), ((0, 0, 0), 1e8), ((0, 0, 0), 1e-6)])
def test_positions_beyond_24_bits_are_refused(tmp_path, center, size):
    with pytest.raises(SceneError, match=r"a\.spz: positions reach .* SPZ's 24 bits cannot resolve: move"):
        write_spz(tmp_path / "a.spz", splats(center=center, size=size))
    assert not list(tmp_path.iterdir())


def with_header(*values, **more):
    return gzip.compress(header(*values, **more) + b"".join(columns(splats(9), 3)), mtime=0)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (gzip.compress(b"", mtime=0), "header ends after 0 bytes"),
        (gzip.compress(b"hello, this is a text", mtime=0), "its header says b'hell'"),
        (b"\x1f\x8b\x08\0", "header ends after 0 bytes"),
        (b"\x1f\x8bxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx", "not a whole gzip"),
        (with_header(1, 9), "version 1, .*expected 'NGSP', version 2 to 4"),
        (with_header(3, 0), "0 splats"),
        (with_header(3, 10), "10 splats need 200 bytes, it unpacks to 180: it is truncated"),
        (with_header(3, 9, degree=3), "it is truncated"),
        (with_header(3, 9, degree=9), "degree 9"),
        (with_header(3, 9, bits=60), "60 fraction bits"),
        (with_header(3, 2**32 - 1), "made to fill memory"),
        (gzip.compress(header(3, 10**7) + bytes(1 << 21), mtime=0), "made to fill memory"),
        (b"NGSP", "header ends after 4 bytes"),
        (b"NGSP\4\0\0\0" + bytes(30), "0 splats"),
        (header(4, 9, last=5) + struct.pack("<I", 10**6), "table of 5 columns at byte 1000000"),
        (header(4, 9, last=2) + struct.pack("<I12x", 32) + bytes(99), "table of 2 columns"),
        (header(4, 9, last=5) + struct.pack("<I12x", 32) + struct.pack("<QQ", 9, 81) * 5 + bytes(99), "damaged|claims"),
    ],
)  # fmt: skip
def test_files_that_lie_are_refused(tmp_path, data, said):
    if data.startswith(b"NGSP"):
        pytest.importorskip("zstandard")
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(SceneError, match=said) as caught:
        read_points(tmp_path / "a.spz")
    assert str(caught.value).startswith(f"{tmp_path / 'a.spz'}: ")


@pytest.mark.parametrize("states_its_size", [True, False])
@pytest.mark.parametrize("unpacked", [1 << 26, 80])
def test_a_column_that_unpacks_to_another_size_is_refused_and_not_unpacked(tmp_path, states_its_size, unpacked):
    zstandard = pytest.importorskip("zstandard")
    frame = zstandard.ZstdCompressor(write_content_size=states_its_size).compress(bytes(unpacked))
    sizes = struct.pack("<QQ", len(frame), 81) * 5
    (tmp_path / "a.spz").write_bytes(header(4, 9, last=5) + struct.pack("<I12x", 32) + sizes + frame * 5)
    tracemalloc.start()
    with pytest.raises(SceneError, match="column 0"):
        read_points(tmp_path / "a.spz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_truncation_is_one_error(tmp_path, version):
    data = packed(splats(9), version)
    for end in range(2, len(data) - 8, 7):  # gzip's last eight bytes are a checksum of what was read
        (tmp_path / "a.spz").write_bytes(data[:end])
        with pytest.raises(SceneError):
            read_points(tmp_path / "a.spz")
