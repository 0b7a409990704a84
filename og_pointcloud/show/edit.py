"""Scene editing (A.2.1): remove, extract or recolor objects of a cloud or 3DGS file, or insert another one.

    og.edit.remove(scene, "red mug", "without.ply", cloud="kitchen.ply")
    og.edit.recolor(scene, "chair", "blue.ply", (40, 70, 220), cloud="kitchen.ply")
    og.edit.extract(scene, og.pick(scene, (1.2, 0.4, 0.8)), "mug.ply", cloud="kitchen.ply")
    og.edit.insert("kitchen.ply", "mug.ply", "two_mugs.ply", pose)

Results are PLY files in the cloud's layout, which any viewer opens, or SPZ for splats. In a PLY, points that the edit
does not affect keep every property and value: spherical harmonics, normals, whatever a trainer added. The original
files are not changed.

The .ogpc file decides which points belong to an object. If the cloud is the one it was made from, row i has the id of
the scene's point i; else each point of the cloud takes the id of the nearest scene point within reach.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, SupportsIndex, TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.ask.labelled_scene import LabelledScene, SceneLike, as_scene
from og_pointcloud.ask.picking import Pick
from og_pointcloud.ask.selecting import Match, Selection, select
from og_pointcloud.bundle.nearest import NearestPoint
from og_pointcloud.cloud import TOO_FAR
from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.gaussian_ply import Splats, gaussian_rows, gaussians_from_ply, holds_gaussians
from og_pointcloud.formats.ply import HEADER_LIMIT, plain_rows, read_ply, write_ply
from og_pointcloud.formats.points import read_points
from og_pointcloud.formats.spz import write_spz
from og_pointcloud.formats.tables import naming, positions
from og_pointcloud.scene import DoubleArray, IntArray, numbers_of, pose_matrix, rotation_error
from og_pointcloud.show.splat_columns import appended, placed, recolored
from og_pointcloud.text.words import TextFeatures

if TYPE_CHECKING:
    from typing_extensions import Unpack

What: TypeAlias = "str | SupportsIndex | Iterable[SupportsIndex] | Pick | Match | Selection"
"""What to edit: a text, for the instances that it fits (`select`); instance ids; the result of `pick` or `select`."""

Rows = NDArray[np.void]

SAME_POINT_SPACINGS = 1e-3
"""Distance, in spacings, up to which a point of the cloud equals the scene's: .ogpc files store float32."""
ROTATION_TOLERANCE = 1e-4
"""Largest deviation of a pose from a rotation times one scale, in any entry of R R' - 1."""


class EditOptions(TypedDict, total=False):
    """cloud: the plain cloud or 3DGS file to edit (PLY, PCD); None for the scene's own points and colors.
    halo: distance in spacings, default 0: points of no instance this close to the object are edited with it, since what
        surrounds an object in a 3DGS file often has no label. text_features: as for ``segment``.
    """

    cloud: StrPath | None
    halo: float
    text_features: TextFeatures


@dataclass(frozen=True)
class Edit:
    """Result of an edit. path: the file written. points: its number of points. changed: number of points removed,
    extracted, recolored or inserted. instances: ids of the edited instances. notes: what could not be kept."""

    path: Path
    points: int
    changed: int
    instances: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()


def remove(scene: SceneLike, what: What, output: StrPath, **options: Unpack[EditOptions]) -> Edit:
    """Write the cloud without some instances.

    scene: a loaded scene, a LabelledCloud or the path of a .ogpc file. what: see `What`. output: a .ply, or for splats
    a .spz; not an input file.
    options: see `EditOptions`.
    Raises OgPointcloudError if ``what`` gives no instance or no point of the cloud belongs to it, SceneError for a
    cloud that cannot be read.
    """
    subject = _subject(scene, what, output, **options)
    if subject.chosen.all():
        raise OgPointcloudError(f"all {len(subject.chosen)} points would be removed; expected some to remain")
    return subject.write(output, subject.rows[~subject.chosen], "removed")


def extract(scene: SceneLike, what: What, output: StrPath, **options: Unpack[EditOptions]) -> Edit:
    """Write only some instances. Arguments and errors as for `remove`."""
    subject = _subject(scene, what, output, **options)
    return subject.write(output, subject.rows[subject.chosen], "extracted")


def recolor(scene: SceneLike, what: What, output: StrPath, color: ArrayLike, **options: Unpack[EditOptions]) -> Edit:
    """Write the cloud with some instances in another color.

    color: (3,) RGB, 0 to 255; becomes the object's mean color. The object keeps its shading, and Gaussians also their
    view dependence. Other arguments and errors as for `remove`.
    """
    rgb = numbers_of(color)
    if rgb.shape != (3,) or rgb.dtype.kind not in "fiu" or not ((rgb >= 0) & (rgb <= 255)).all():
        raise OgPointcloudError(f"color is {color}; expected three numbers from 0 to 255: red, green, blue")
    if (rgb % 1).any() or (rgb.dtype.kind == "f" and 0 < rgb.max() <= 1):  # 1.0 is nearly black, or full
        raise OgPointcloudError(f"color is {color}; expected whole numbers: scale to 0..255")
    subject = _subject(scene, what, output, **options)
    return subject.write(output, recolored(subject.rows, subject.chosen, rgb / 255), "recolored")


def insert(
    cloud: StrPath, other: StrPath, output: StrPath,
    pose: ArrayLike | None = None,
) -> Edit:  # fmt: skip
    """Write a cloud with another one inserted, both plain clouds or both 3DGS files.

    pose: (4, 4), maps the other's coordinates to the cloud's: a rotation, one scale for all axes, and a translation.
    Left out: they share a frame. It is applied to positions, normals, rotations and scales of Gaussians, and exactly to
    spherical harmonics up to degree 3. The result has the cloud's properties; those that the other lacks are 0 for its
    points, and positions become float64 if float32 would move points by more than 1e-6 of the extent.
    SceneError for a pose that shears or mirrors, and for clouds of different kinds or that cannot be read.
    """
    rotation, scale, translation = _similarity(pose)
    _check_output(output, [cloud, other])
    base, added = _read(Path(cloud)), _read(Path(other))
    if holds_gaussians(base.elements) != holds_gaussians(added.elements):
        raise SceneError(f"one of {cloud} and {other} has Gaussians, the other plain points; expected the same kind")
    moved, lost = placed(added.rows, rotation, scale, translation)
    merged, differing = appended(base.rows, moved)
    inserted = np.arange(len(merged)) >= len(base.rows)
    notes = (*base.notes, *added.notes, *lost, *differing)
    return _Cloud(base.elements, notes, inserted).write(output, merged, "inserted")


# What is edited ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cloud:
    """The elements of a file, with rows of ``vertex`` in the layout to write, and the points to edit.

    notes: what could not be kept. chosen: (n,) bool, the rows to edit. instances: the instances that they belong to.
    """

    elements: Mapping[str, Rows]
    notes: tuple[str, ...] = ()
    chosen: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    instances: tuple[int, ...] = ()

    @property
    def rows(self) -> Rows:
        return self.elements["vertex"]

    def write(self, output: StrPath, rows: Rows, verb: str) -> Edit:
        """Write the cloud with other rows."""
        changed, elements, notes = int(self.chosen.sum()), {**self.elements, "vertex": rows}, self.notes
        if Path(output).suffix == ".spz":
            notes = (*notes, "SPZ: harmonics above the constant one and other properties are left out")
            if not holds_gaussians(elements):
                raise SceneError(f"{output} stores only splats, the cloud has plain points; expected .ply, or splats")
            splats = gaussians_from_ply(elements)
            notes, rows = (*notes, *_left_out(output, splats)), rows[splats.finite]
            write_spz(output, splats.points)
        else:
            write_ply(output, elements, [f"edited by og-pointcloud: {changed} points {verb}"])
        return Edit(Path(output), len(rows), changed, self.instances, notes)


def _subject(
    scene: SceneLike, what: What, output: StrPath, cloud: StrPath | None = None,
    halo: float = 0.0, text_features: TextFeatures = None,
) -> _Cloud:  # fmt: skip
    """Read the cloud and find the points to edit."""
    if not (isinstance(halo, Real) and 0 <= halo < np.inf):
        raise OgPointcloudError(f"halo is {halo}; expected a number of spacings, at least 0")
    scene = as_scene(scene)
    _check_output(output, [path for path in (cloud, scene.path) if path is not None])
    instances = _instances_meant(scene, what, text_features)
    source = _Cloud({"vertex": plain_rows(scene.xyz, scene.cloud.rgb)}) if cloud is None else _read(Path(cloud))
    xyz = positions(source.rows)
    ids, notes = _ids_of_points(scene, xyz, cloud)
    chosen = np.isin(ids, instances)
    if not chosen.any():
        raise OgPointcloudError(
            f"none of the {len(xyz)} points belongs to instance {', '.join(map(str, instances))}: it has no points, or "
            "the cloud does not show it"
        )
    if halo > 0:
        chosen |= _halo(scene, xyz, ids, chosen, halo)
    return _Cloud(source.elements, (*source.notes, *notes), chosen, instances)


def _instances_meant(scene: LabelledScene, what: What, text_features: TextFeatures) -> tuple[int, ...]:
    count = len(scene.cloud.instances)
    origin = what.scene if isinstance(what, (Pick, Selection)) else what._scene if isinstance(what, Match) else scene
    if not _is_same(origin, scene):
        raise OgPointcloudError(
            f"the {type(what).__name__} to edit is from {origin!r:.80}, but the scene is {scene!r:.80}; expected one "
            "from this scene"
        )
    # Converted to ids step by step: a text to a selection, a selection to its instances, a match or pick to its id.
    if isinstance(what, str):
        what = select(scene, what, text_features=text_features)
    if isinstance(what, Selection) and not what.fitting:
        raise OgPointcloudError(f"'{what.query}' fits none of {count} instances better than other words do: pass an id")
    if isinstance(what, Pick) and not what.found:
        raise OgPointcloudError(f"the click hit {what}; expected an instance to edit: click elsewhere")
    what = what.instances if isinstance(what, Selection) else what
    what = what.instance if isinstance(what, (Pick, Match)) else what
    ids = tuple(what) if isinstance(what, Iterable) else (what,)
    wrong = [k for k in ids if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or not 0 <= k < count]
    if wrong or not ids:
        raise OgPointcloudError(
            f"the instances to edit are {[*ids]!r:.80}; expected ids from 0 to {count - 1}, at least one: a click may "
            "have missed"
        )
    return tuple(int(k) for k in dict.fromkeys(ids))


def _is_same(one: LabelledScene, other: LabelledScene) -> bool:
    """Whether ids mean the same points in both scenes: a file may be opened twice, or sent to another process."""
    return one is other or (
        np.array_equal(one.cloud.xyz, other.cloud.xyz) and np.array_equal(one.instance_ids, other.instance_ids)
    )


def _ids_of_points(scene: LabelledScene, xyz: DoubleArray, cloud: StrPath | None) -> tuple[IntArray, tuple[str, ...]]:
    """Instance id of each point of the cloud: the scene's if it is the same cloud, else the nearest point's; notes."""
    if len(xyz) == len(scene.cloud) and (np.abs(xyz - scene.xyz) <= SAME_POINT_SPACINGS * scene.cloud.spacing).all():
        return scene.instance_ids, ()
    ids = scene.instances_at(xyz)
    far = int((ids == TOO_FAR).sum())
    if far == len(ids):
        raise OgPointcloudError(
            f"{cloud}: none of its {len(xyz)} points lies within {scene.cloud.reach:.4g} of the scene; expected the "
            "cloud that the .ogpc was made from, or another of the same place in the same frame"
        )
    return ids, (
        f"{cloud} has {len(xyz)} points, the scene {len(scene.cloud)}, or they differ: each took the instance "
        f"of the nearest scene point, and {far} have none within reach",
    )


def _halo(
    scene: LabelledScene, xyz: DoubleArray, ids: IntArray, chosen: NDArray[np.bool_], halo: float
) -> NDArray[np.bool_]:
    """(n,) bool, points of no instance that lie within ``halo`` spacings of a chosen one."""
    local = (xyz - scene.cloud.origin).astype(np.float32)
    unassigned = np.flatnonzero((ids < 0) & np.isfinite(local).all(axis=1))
    spacing = scene.cloud.spacing
    nearest = NearestPoint(local[chosen], spacing, halo * spacing).query(local[unassigned])
    in_halo = np.zeros(len(xyz), bool)
    in_halo[unassigned[nearest >= 0]] = True
    return in_halo


def _check_output(output: StrPath, inputs: Iterable[StrPath]) -> None:
    path = Path(output)
    if path.suffix not in (".ply", ".spz"):
        raise OgPointcloudError(f"the output is '{path}'; expected a name that ends in .ply, or .spz for splats")
    for source in inputs:
        if path.exists() and Path(source).exists() and path.samefile(source):
            raise OgPointcloudError(
                f"the output is '{path}', which is an input; expected another name: inputs are kept"
            )


# Reading ----------------------------------------------------------------------------------------------------------


def _read(path: Path) -> _Cloud:
    """A cloud's elements: those of a PLY as they are, other formats converted to PLY's."""
    # The header alone identifies a PLY, and tells whether it has lists, which are not read.
    with naming(path), path.open("rb") as file:
        head = file.read(HEADER_LIMIT).partition(b"end_header")[0]
    if not head.startswith(b"ply"):
        points = read_points(path)
        if points.scale is not None:
            return _Cloud(
                {"vertex": gaussian_rows(points)}, (f"{path}: harmonics above the constant one are left out",)
            )
        columns = f"{path}: only positions and colors are kept, as a PLY"
        return _Cloud({"vertex": plain_rows(points.xyz_world, points.rgb)}, (columns,))
    with naming(path):
        elements = read_ply(path)
        if len(elements.get("vertex", ())) == 0:
            raise SceneError("no points; expected an element 'vertex' of plain properties")
        if "packed_position" in (elements["vertex"].dtype.names or ()):  # SuperSplat's compressed splats
            splats = gaussians_from_ply(elements)
            notes = f"{path}: unpacked; harmonics above the constant one are left out", *_left_out(path, splats)
            return _Cloud({"vertex": gaussian_rows(splats.points)}, notes)
        if not np.isfinite(positions(elements["vertex"])).all():
            raise SceneError("positions contain NaN or infinity; expected finite ones: remove those points first")
    return _Cloud(elements, (f"{path}: faces and other lists are left out",) if b"\nproperty list" in head else ())


def _left_out(path: StrPath, splats: Splats) -> tuple[str, ...]:
    """The note on Gaussians that are not finite, if there are any."""
    return (f"{path}: {splats.others}: left out",) if splats.others else ()


def _similarity(pose: ArrayLike | None) -> tuple[DoubleArray, float, DoubleArray]:
    """Rotation (3, 3), scale and translation (3,) of a pose."""
    matrix = pose_matrix(np.eye(4) if pose is None else pose)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    scale = np.cbrt(determinant)  # det(s R) = s^3
    rotation = matrix[:3, :3] / (scale if scale > 0 else 1)
    if scale <= 0 or not rotation_error(rotation)[0] <= ROTATION_TOLERANCE:  # also if the error is NaN
        raise SceneError(
            f"pose has a determinant of {determinant:.4g} and shears or mirrors; expected a rotation times one "
            "positive scale: Gaussians cannot follow other poses"
        )
    return rotation, float(scale), matrix[:3, 3]
