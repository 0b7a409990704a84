"""SOG: a literal packer's files are read back, and files that lie are refused."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
import zipfile

import cv2
import numpy as np
import pytest
from test_formats_spz import splats

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.points import read_points

TABLE = [(k - 200) / 16 for k in range(256)]
COLORS = [(k - 128) / 60 for k in range(256)]
IMAGES = ("means_l", "means_u", "scales", "quats", "sh0")


def webp(pixels):
    """Lossless, of (h, w, 3 or 4) uint8 RGB or RGBA."""
    order = [2, 1, 0, *range(3, pixels.shape[2])]
    return cv2.imencode(".webp", np.ascontiguousarray(pixels[..., order]), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def to_log(value):
    return math.copysign(math.log(abs(value) + 1), value)


def packed(points, width=8):
    """Members of a SOG file, splat by splat, as the format's text has it. Alpha is nowhere 0: encoders may drop the
    colors there."""
    height = -(-len(points) // width)
    images = {name: np.full((height * width, 4), 255, np.uint8) for name in IMAGES}
    logs = [[to_log(value) for value in row] for row in points.xyz_world.tolist()]
    mins, maxs = np.min(logs, axis=0).tolist(), np.max(logs, axis=0).tolist()
    for k in range(len(points)):
        for axis in range(3):
            share = (logs[k][axis] - mins[axis]) / ((maxs[axis] - mins[axis]) or 1)
            images["means_u"][k, axis], images["means_l"][k, axis] = divmod(round(share * 65535), 256)
            images["scales"][k, axis] = nearest(TABLE, math.log(points.scale[k, axis]))
            images["sh0"][k, axis] = nearest(COLORS, (points.rgb[k, axis] / 255 - 0.5) * 2 * math.sqrt(math.pi))
        images["sh0"][k, 3] = max(1, round(float(points.opacity[k]) * 255))
        wxyz = points.rotation[k].tolist()
        largest = max(range(4), key=lambda part: abs(wxyz[part]))
        sign = -1 if wxyz[largest] < 0 else 1
        others = [sign * value for part, value in enumerate(wxyz) if part != largest]
        images["quats"][k] = [*(round((value / math.sqrt(2) + 0.5) * 255) for value in others), 252 + largest]
    files = {name: [f"{name}.webp"] for name in IMAGES[2:]}
    meta = {
        "version": 2, "count": len(points),
        "means": {"mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": TABLE, "files": files["scales"]}, "quats": {"files": files["quats"]},
        "sh0": {"codebook": COLORS, "files": files["sh0"]},
    }  # fmt: skip
    of_three = ("means_l", "means_u", "scales")
    return meta, {
        f"{name}.webp": webp(image.reshape(height, width, 4)[..., : 3 if name in of_three else 4])
        for name, image in images.items()
    }


def nearest(table, value):
    return min(range(256), key=lambda k: abs(table[k] - value))


def written(path, meta, members, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("meta.json", meta if isinstance(meta, bytes) else json.dumps(meta))
        for name, data in members.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_what_a_literal_packer_wrote_comes_back(tmp_path, method):
    points = splats(61, size=30.0)  # three pixels of the last row are of no splat
    back = read_points(written(tmp_path / "a.sog", *packed(points), method))
    assert len(back) == 61
    logs = np.array([[to_log(value) for value in row] for row in points.xyz_world.tolist()])
    steps = np.ptp(logs, axis=0) / 65535
    off = np.abs(back.xyz_world - points.xyz_world) / (1 + np.abs(points.xyz_world))
    assert (off < 0.6 * steps).all()
    assert (np.abs(np.log(back.scale) - np.log(points.scale)) < 0.032).all()  # tables have steps of 1/16
    assert (np.abs(back.rgb.astype(int) - points.rgb) <= 1).all()
    assert (np.abs(back.opacity - points.opacity) <= 1 / 255).all()
    assert (np.abs((back.rotation * points.rotation).sum(axis=1)) > 1 - 1e-4).all()


def changed(meta, **change):
    """meta.json with some entries changed; None removes one."""
    return {key: value for key, value in {**meta, **change}.items() if value is not None}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda meta: changed(meta, version=1), "version 1; expected 2"),
        (lambda meta: changed(meta, count=None), "None splats"),
        (lambda meta: changed(meta, count=True), "True splats"),
        (lambda meta: changed(meta, count=0), "0 splats"),
        (lambda meta: changed(meta, count=65), "8x8 pixels; expected one for each of 65 splats"),
        (lambda meta: changed(meta, count=10**30), "splats; expected one or more, as many as it holds"),
        (lambda meta: changed(meta, quats=None), r"no image 0 of quats \(None\)"),
        (lambda meta: changed(meta, quats={"files": ["../quats.webp"]}), "no image 0 of quats"),
        (lambda meta: changed(meta, quats={"files": ["scales.webp"]}), "are not 252 to 255|are 252"),
        (lambda meta: changed(meta, means={**meta["means"], "mins": [0, 1]}), "expected 3 numbers"),
        (lambda meta: changed(meta, means={**meta["means"], "maxs": [1e9] * 3}), "are not finite"),
        (lambda meta: changed(meta, means={**meta["means"], "maxs": [10**400] * 3}), "beyond float64"),
        (lambda meta: changed(meta, scales={**meta["scales"], "codebook": TABLE[:9]}), "expected 256 numbers"),
        (lambda meta: changed(meta, sh0={**meta["sh0"], "codebook": [math.nan] * 256}), "are not finite"),
        (lambda meta: [], "version None"),
        (lambda meta: b"\xff{", "is no JSON"),
        (lambda meta: b"[" * 100_000, "is no JSON"),
    ],
)
def test_a_file_that_lies_is_refused(tmp_path, change, says):
    meta, members = packed(splats(60))
    members["scales.webp"] = webp(cv2.imdecode(np.frombuffer(members["scales.webp"], np.uint8), -1)[..., [2, 1, 0, 0]])
    path = written(tmp_path / "a.sog", change(meta), members)
    with pytest.raises(SceneError, match=says) as caught:
        read_points(path)
    assert str(caught.value).startswith(str(path))


def test_what_is_no_sog_is_told(tmp_path):
    meta, members = packed(splats(60))
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("other.txt", "x")
    with pytest.raises(SceneError, match=r"without meta\.json"):
        read_points(path)
    for name, data in {"sh0.webp": b"no image", "means_u.webp": members["means_u.webp"][:40]}.items():
        with pytest.raises(SceneError, match=f"{name}.* cannot be decoded|{name} has 0x0"):
            read_points(written(path, meta, {**members, name: data}))
    whole = written(path, meta, members).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match="not a whole zip, as a SOG file is"):
        read_points(path)


def test_a_file_made_to_fill_memory_is_refused_unread(tmp_path):
    meta, members = packed(splats(60))
    members["sh0.webp"] = webp(np.full((6000, 8000, 4), 255, np.uint8))  # 192 MB in a few kB
    path = written(tmp_path / "a.sog", meta, members)
    tracemalloc.start()
    with pytest.raises(SceneError, match="8000x6000 pixels; expected one for each of 60 splats"):
        read_points(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 23
    tracemalloc.stop()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 22))
    with pytest.raises(SceneError, match=r"a\.sog: meta\.json claims 4194304 bytes; expected at most 1048576$"):
        read_points(path)


def test_a_directory_that_points_anywhere_is_no_bare_error(tmp_path):
    meta, members = packed(splats(60))
    path = written(tmp_path / "a.sog", meta, members)
    whole = bytearray(path.read_bytes())
    start = whole.index(b"PK\x01\x02")
    said = set()
    for at in range(start, len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read_points(path)
        except SceneError as error:
            said.add(str(error).partition(": ")[2][:15])
    assert any(text.startswith("not a whole zip") for text in said)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused_unread(tmp_path, method):
    """Python unpacks them whole, whatever size the zip states: a gigabyte of 900 bytes of bz2."""
    path = written(tmp_path / "a.sog", b" " * (1 << 25), {}, method)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 1000)  # the size that it states
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(
            SceneError, match=rf"sog: meta.json is compressed by method {method}; expected 0 .* or 8 .*: export"
        ):
            read_points(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()
