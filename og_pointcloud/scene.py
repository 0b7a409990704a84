"""The input of training: points and views. This file defines all frames and units.

Frames. Cameras are OpenCV (x right, y down, z forward); ``world_to_camera`` maps local world coordinates to the
camera. Pixel (row i, column j) has its center at (j + 0.5, i + 0.5). World coordinates are ``local + origin``:
the origin (float64) removes map offsets of 1e6, so that everything after reading works in float32 near zero.

Units. Whatever the capture uses; no threshold of the library is an absolute length, all are multiples of the point
spacing or shares of the scene extent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from numbers import Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from og_pointcloud.errors import SceneError

FloatArray = NDArray[np.float32]
DoubleArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Item = TypeVar("Item")

MIN_FOCAL_SHARE = 1e-6
"""Smallest focal length as a share of the image's side: with a shorter one every pixel sees half of the world."""
MAX_SIDE_PX = 1 << 17
"""Largest side of an image; no camera has more."""
NOT_SEEN = -2
"""In a mask map: a pixel that the lens did not see, which tells nothing; -1 tells that no mask is there."""
MAX_VALUES_SHOWN = 12
"""A record's repr shows arrays and tuples of up to this many values in full."""
ROTATION_TOLERANCE = 1e-2
"""Largest deviation of a rotation's rows from orthonormality, in any entry of R R' - 1."""
UNIT_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's length from 1; it scales a Gaussian by its square, so by twice this share."""


def brief(self: Any) -> str:
    """A short repr of a dataclass with large fields: arrays as type and shape, long tuples as their length.

    >>> import numpy as np
    >>> from og_pointcloud.scene import Points
    >>> Points(np.zeros((7000, 3), np.float32), np.zeros(3))
    Points(xyz=<float32 (7000, 3)>, origin=array([0., 0., 0.]))
    """
    values = {each.name: getattr(self, each.name) for each in fields(self)}
    shown = (f"{name}={_brief(value)}" for name, value in values.items() if value is not None)
    return f"{type(self).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.size > MAX_VALUES_SHOWN:
        return f"<{value.dtype} {value.shape}>"
    if isinstance(value, dict) or (
        isinstance(value, tuple) and (len(value) > MAX_VALUES_SHOWN or any(map(is_dataclass, value)))
    ):
        return f"<{len(value)}>"
    return "<read when asked for>" if callable(value) else repr(value)


def take_arrays(record: Any, *names: str) -> None:
    """Convert lists and torch tensors in these fields of a frozen record to arrays; SceneError for ragged lists."""
    for name in names:
        value = getattr(record, name)
        if _is_of_torch(value):
            object.__setattr__(record, name, numbers_of(value).copy())
        if isinstance(value, list | tuple):
            try:
                object.__setattr__(record, name, np.asarray(value))
            except ValueError:
                raise SceneError(f"{name} is {value!r:.80}; expected an array: its rows differ in length") from None


def numbers_of(value: Any) -> NDArray[Any]:
    """np.asarray that also takes torch tensors; for a value that it cannot convert, such as rows of different lengths,
    a scalar None, which matches no expected shape."""
    try:
        return np.asarray(dense_tensor(value) if _is_of_torch(value) else value)
    except Exception:  # arrays of GPU libraries raise types of their own
        return np.array(None)


def _is_of_torch(value: Any) -> bool:
    return any(kind.__module__.partition(".")[0] == "torch" for kind in type(value).__mro__)


def dense_tensor(tensor: Any) -> NDArray[Any] | None:
    """A torch tensor on any device as an array; None for a sparse tensor or anything else."""
    try:
        tensor = tensor.detach().cpu()
        known = not tensor.is_floating_point() or tensor.dtype.itemsize > 2  # numpy has no bfloat16
        return (tensor if known else tensor.double()).numpy()
    except (AttributeError, TypeError, RuntimeError):
        return None


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    width, height: pixels, whole numbers. fx, fy, cx, cy: pixels (pixel centers at +0.5).
    world_to_camera: (4, 4) float64 rigid transform from the scene's local frame, OpenCV axes; copied.

    >>> import numpy as np
    >>> import og_pointcloud as og
    >>> camera = og.Camera(640, 480, 500.0, 500.0, 320.0, 240.0, np.eye(4))
    >>> camera.project(np.array([[0, 0, 2.0], [0.4, 0, 2]]))
    (array([[320., 240.],
           [420., 240.]]), array([2., 2.]))
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: DoubleArray

    def __post_init__(self) -> None:
        pose = pose_matrix(self.world_to_camera, "camera pose", ": drop or repair this view")
        object.__setattr__(self, "world_to_camera", pose)
        numbers = (self.width, self.height, *self.intrinsics)
        if not all(isinstance(number, Real) for number in numbers):
            raise SceneError(f"a camera's width, height, fx, fy, cx, cy are {numbers}; expected numbers, in pixels")
        error, determinant = rotation_error(pose[:3, :3])
        if not error <= ROTATION_TOLERANCE or determinant < 0:  # also where the error is NaN
            raise SceneError(
                f"camera rotation differs from a rotation matrix by {error:.3g} (det {determinant:.3g}); expected a "
                "rigid right-handed pose: remove scale or mirroring from the pose file"
            )
        # Sizes are checked before focal lengths, which are compared with them.
        if not all(1 <= side <= MAX_SIDE_PX and side == int(side) for side in (self.width, self.height)):
            raise SceneError(
                f"camera image is {self.width!s:.12}x{self.height!s:.12}; expected whole numbers from 1 to "
                f"{MAX_SIDE_PX}: check w and h in the pose file"
            )
        for name in ("width", "height"):
            object.__setattr__(self, name, int(getattr(self, name)))  # 64.0 cannot be a shape
        if not np.isfinite(self.intrinsics).all() or min(self.fx / self.width, self.fy / self.height) < MIN_FOCAL_SHARE:
            raise SceneError(
                f"camera intrinsics fx, fy, cx, cy are {self.intrinsics}; expected finite numbers, with fx and fy at "
                f"least {MIN_FOCAL_SHARE:g} of the image's sides: check the camera model in the pose file"
            )

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with its image scaled to width x height pixels."""
        # (0, 0) is the image's corner, pixel centers lie at +0.5: the principal point scales as the focal length does.
        if (width, height) == (self.width, self.height):
            return self
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def project(self, xyz: NDArray[np.floating]) -> tuple[DoubleArray, DoubleArray]:
        """Project points: uv_px (n, 2) column and row, pixel centers at +0.5, and depth (n,) along the view axis.

        xyz: (n, 3) in the frame that ``world_to_camera`` maps from. Computed in float64. Points that are not in front
        of the camera (depth <= 0) have NaN for uv_px, which compares false with everything; points outside the image
        have the pixel they would have in a larger one.
        """
        in_camera = xyz @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        x, y, depth = in_camera.T
        # NaN, since division by a depth <= 0 would mirror points behind the camera into the image.
        in_front = np.where(depth > 0, depth, np.nan)
        return np.stack([self.fx * x / in_front + self.cx, self.fy * y / in_front + self.cy], axis=1), depth

    def shows(self, uv_px: DoubleArray) -> NDArray[np.bool_]:
        """(n,) bool: which pixel coordinates (n, 2) of `project` lie in the image; NaN does not."""
        u, v = uv_px.T
        return (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def center(self) -> DoubleArray:
        """Camera center in the local frame, (3,) float64."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        # Not by the transpose: of rounded rows in map coordinates, that is meters from where `project` looks from.
        center = np.linalg.solve(rotation, -translation) + 0.0  # no -0
        return center.astype(np.float64, copy=False)


@dataclass(frozen=True, eq=False)
class CutMasks:
    """Origin of the masks of a view that is one of several cut from a photograph: parts of the photograph's masks.

    photograph: its name. rows: (M,) int64, the photograph's mask that each mask of the view is a part of.
    """

    photograph: str
    rows: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class View:
    """One posed image with its masks.

    name: the image's file stem, unique in the scene.
    masks: (H, W) int32, -1 outside every mask, NOT_SEEN where the photograph shows nothing (beyond a lens's rim), else
        a row of ``mask_features``; or a function that reads it, so that long captures are streamed. H, W of the camera.
    mask_features: (M, D) float32, one row per mask, as the encoder gave it (not normalized).
    image: (H, W, 3) uint8 RGB, or a function that reads it, or None where the capture has no images.
    mask_tracks: (M,) integers, a tracker's id of the thing in each mask, equal for the same thing in all views, -1
        unknown; None without a tracker.
    cut_from: the photograph whose masks these are parts of; None if they are masks of this view.
    """

    name: str
    camera: Camera
    masks: IntArray | Callable[[], IntArray]
    mask_features: FloatArray
    image: NDArray[np.uint8] | Callable[[], NDArray[np.uint8]] | None = None
    mask_tracks: NDArray[np.integer] | None = None
    cut_from: CutMasks | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise SceneError(f"a view's name is {self.name!r:.80}; expected text, such as its image's file stem")
        if not isinstance(self.camera, Camera):
            raise SceneError(f"view '{self.name}': the camera is a {type(self.camera).__name__}; expected an og.Camera")
        take_arrays(self, "image", "mask_features", "mask_tracks")
        features = np.asarray(self.mask_features)
        if features.ndim != 2 or features.dtype != np.float32:
            raise SceneError(
                f"view '{self.name}': mask features are {features.dtype} {features.shape}; expected float32 (masks, "
                "dimension): pass features.astype(np.float32)"
            )
        if features.shape[1] == 0 and len(features):
            raise SceneError(
                f"view '{self.name}': the features of its {len(features)} masks have dimension 0; expected 1 or more: "
                "encode the masks, or give zero rows for those without a feature"
            )
        finite = np.isfinite(features).all(axis=1)
        if not finite.all():
            raise SceneError(
                f"view '{self.name}': the feature of mask {int(np.argmin(finite)) + 1} contains NaN or infinity; "
                "expected finite numbers: encode this mask again or remove it"
            )
        tracks = self.mask_tracks
        if tracks is not None and (tracks.shape != (len(features),) or tracks.dtype.kind not in "iu"):
            raise SceneError(
                f"view '{self.name}': mask tracks are {tracks.dtype} {tracks.shape}; expected a whole number for each "
                f"of {len(features)} masks: write -1 for a mask without a track"
            )

    @property
    def mask_count(self) -> int:
        """Number of masks, which is the number of feature rows."""
        return len(self.mask_features)

    def mask_map(self) -> IntArray:
        """(H, W) int32: NOT_SEEN, -1 or a row of ``mask_features``. Read and checked anew on every call."""
        ids = np.asarray(self.masks() if callable(self.masks) else self.masks)
        expected = (self.camera.height, self.camera.width)
        if ids.dtype.kind not in "iu" or ids.ndim != 2:
            raise SceneError(
                f"view '{self.name}': the mask map is {ids.dtype} {ids.shape}; expected whole numbers {expected}: rows "
                "of mask_features, -1 outside of masks"
            )
        if ids.shape != expected:
            raise SceneError(
                f"view '{self.name}': the mask image is {ids.shape[1]}x{ids.shape[0]} pixels, its camera "
                f"{expected[1]}x{expected[0]}: make the masks at the image's size or fix w and h in the pose file"
            )
        if ids.size and int(ids.min()) < NOT_SEEN:
            raise SceneError(
                f"view '{self.name}': the mask map contains {int(ids.min())}; expected rows of mask_features, -1 or "
                f"{NOT_SEEN}: set pixels without a mask to -1"
            )
        if ids.size and int(ids.max()) >= self.mask_count:
            raise SceneError(
                f"view '{self.name}': mask id {int(ids.max()) + 1} has no feature row (the features file has "
                f"{self.mask_count}): write one feature row per mask id"
            )
        return np.ascontiguousarray(ids, np.int32)

    def image_rgb(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) uint8 RGB at the camera's size, or None where the view has no image."""
        image = self.image() if callable(self.image) else self.image
        expected = (self.camera.height, self.camera.width, 3)
        if image is not None and (image.shape != expected or image.dtype != np.uint8):
            raise SceneError(
                f"view '{self.name}': the image is {image.dtype} {image.shape}; expected uint8 {expected}, the size of "
                "its camera: fix w and h in the pose file, or scale colors to 0..255"
            )
        return image


@dataclass(frozen=True, eq=False)
class Points:
    """A plain cloud, or Gaussians when scale, rotation and opacity are known (all three or none).

    xyz: (n, 3) float32, local frame. origin: (3,) float64, world = xyz + origin. rgb: (n, 3) uint8 or None.
    scale: (n, 3) float32, linear standard deviations.
    rotation: (n, 4) float32 quaternions wxyz, unit. opacity: (n,) float32 in [0, 1].
    """

    xyz: FloatArray
    origin: DoubleArray
    rgb: NDArray[np.uint8] | None = None
    scale: FloatArray | None = None
    rotation: FloatArray | None = None
    opacity: FloatArray | None = None

    __repr__ = brief

    @classmethod
    def from_world(
        cls,
        xyz: NDArray[np.floating],
        *,
        rgb: NDArray[np.uint8] | None = None,
        scale: FloatArray | None = None,
        rotation: FloatArray | None = None,
        opacity: FloatArray | None = None,
    ) -> Points:
        """Points from world coordinates (n, 3) of any float type; the median becomes the origin. xyz and rgb are
        copied."""
        world = np.asarray(xyz)
        if world.ndim != 2 or world.shape[1] != 3 or world.dtype.kind not in "fiu":
            raise SceneError(f"points are {world.dtype} {world.shape}; expected numbers of shape (points, 3)")
        world = world.astype(np.float64)
        if len(world) == 0:
            raise SceneError("the cloud has 0 points; expected at least one: check the geometry file")
        require_finite(world)
        origin = np.median(world, axis=0)  # a few outliers do not move it away from the points, which would cost digits
        extent = float(np.abs(world - origin).max())
        if extent > float(np.finfo(np.float32).max):
            raise SceneError(
                f"points lie up to {extent:.3g} from their median; expected less than float32's 3.4e38: "
                "remove the outliers, or scale the cloud and its poses"
            )
        colors = rgb.copy() if isinstance(rgb, np.ndarray) else rgb
        return cls((world - origin).astype(np.float32), origin, colors, scale, rotation, opacity)

    def __post_init__(self) -> None:
        take_arrays(self, "xyz", "origin", "rgb", "scale", "rotation", "opacity")
        n = len(self.xyz)
        if self.xyz.shape != (n, 3) or self.xyz.dtype != np.float32 or np.shape(self.origin) != (3,):
            raise SceneError(
                f"xyz is {self.xyz.dtype} {self.xyz.shape}, origin of shape {np.shape(self.origin)}; expected float32 "
                f"{(n, 3)} near zero and (3,): Points.from_world(xyz) makes them from world coordinates"
            )
        widths = {"rgb": 3, "scale": 3, "rotation": 4, "opacity": None}
        for name, width in widths.items():
            value = getattr(self, name)
            expected = (n,) if width is None else (n, width)
            if value is not None and value.shape != expected:
                raise SceneError(f"{name} has shape {value.shape}; expected {expected}")
        if self.rgb is not None and self.rgb.dtype != np.uint8:
            raise SceneError(f"rgb is {self.rgb.dtype}; expected uint8: scale colors to 0..255 and convert them")
        # An incomplete Gaussian cannot be rendered.
        given = [name for name in ("scale", "rotation", "opacity") if getattr(self, name) is not None]
        if given and len(given) < 3:
            raise SceneError(f"Gaussians need scale, rotation and opacity together; got only {', '.join(given)}")
        require_finite(self.xyz)
        if given:
            _check_gaussians(*self.gaussians)

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: NDArray[np.integer]) -> Points:
        """The points of these rows, in their order, with all attributes."""
        names = ("rgb", "scale", "rotation", "opacity")
        columns: dict[str, Any] = {name: getattr(self, name) for name in names}
        chosen = {name: None if column is None else column[rows] for name, column in columns.items()}
        return Points(self.xyz[rows], self.origin, **chosen)

    @property
    def are_gaussians(self) -> bool:
        """Whether scale, rotation and opacity are known."""
        return self.scale is not None

    @property
    def gaussians(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Scale, rotation and opacity of every point; SceneError for a plain cloud."""
        if self.scale is None or self.rotation is None or self.opacity is None:
            raise SceneError("the points have no scale, rotation and opacity; expected Gaussians, as in a 3DGS file")
        return self.scale, self.rotation, self.opacity

    @property
    def xyz_world(self) -> DoubleArray:
        """World coordinates, (n, 3) float64."""
        return self.xyz.astype(np.float64) + self.origin


def pose_matrix(pose: ArrayLike, what: str = "pose", cure: str = ", cloud to world") -> DoubleArray:
    """A pose (4, 4) as a float64 copy. SceneError, which calls it ``what``, for numbers that are not finite or a last
    row other than 0 0 0 1."""
    matrix = numbers_of(pose)
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        seen = f"{matrix.dtype} {matrix.shape}, {matrix.tolist()!s:.60}"
        raise SceneError(f"{what} is {seen}; expected a finite 4x4 matrix{cure}")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise SceneError(
            f"the last row of {what} is {matrix[3].tolist()}; expected 0 0 0 1: pass the matrix whose last column is "
            "the translation (this one may be transposed)"
        )
    return matrix.astype(np.float64)


def rotation_error(matrix: DoubleArray) -> tuple[float, float]:
    """Largest entry of R R' - 1 for a matrix (3, 3), 0 for orthonormal rows, NaN where it overflows; and det R."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return float(np.abs(matrix @ matrix.T - np.eye(3)).max()), float(np.linalg.det(matrix))


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` items, spread evenly over the sequence."""
    rows = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[row] for row in np.unique(rows)]


def middle_extent(xyz: NDArray[np.floating]) -> float:
    """The longest side of the box around the middle 90 % of finite points (n, 3), n >= 1, along each axis: a stray at
    the origin of a map is a thousand kilometers from the place."""
    low, high = np.quantile(xyz, [0.05, 0.95], axis=0)
    return float((high - low).max())


def float32_step(xyz_world: NDArray[np.floating]) -> float:
    """Spacing of float32 numbers at the median magnitude of finite points (n, 3), if all their coordinates are float32
    numbers, as in a map that a program stored as float32; else 0."""
    with np.errstate(over="ignore"):
        single = xyz_world.astype(np.float32)
    if single.size == 0 or not np.array_equal(single, xyz_world):
        return 0.0
    return float(np.spacing(np.median(np.abs(single).max(axis=1))))


def rounded_pose(pose: ArrayLike, spacing: float) -> str:
    """Why a pose (4, 4) that was stored as float32 in map coordinates is too coarse for points ``spacing`` apart; "" if
    it is not."""
    matrix = numbers_of(pose)
    # Whole numbers, as in a chosen offset, tell nothing; a rotation whose entries are all float32 numbers does.
    fractions = matrix if matrix.dtype == np.float32 else matrix[:3, :3]
    step = float32_step(matrix.reshape(1, -1)) if (fractions % 1).any() else 0.0
    if step <= spacing:
        return ""
    return (
        f"float32 rounded the pose to steps of {step:.3g}, but the scene's points lie {spacing:.3g} apart: pass "
        "float64 numbers that were never float32"
    )


def require_finite(xyz: NDArray[np.floating], cure: str = "remove them from the cloud first") -> None:
    """SceneError for points (n, 3) with NaN or infinity."""
    finite = np.logical_and.reduce(np.isfinite(xyz), axis=1)
    if not finite.all():
        raise SceneError(
            f"{int((~finite).sum())} of {len(finite)} points contain NaN or infinity (the first is row "
            f"{int(np.argmin(finite))}); expected finite coordinates: {cure}"
        )


def _check_gaussians(scale: FloatArray, rotation: FloatArray, opacity: FloatArray) -> None:
    """Check Gaussians made by callers; file readers already activate scales and opacities and normalize quaternions."""
    fits = np.logical_and.reduce((scale >= 0) & (scale < np.inf), axis=1)
    _require(fits, scale, "scale", "finite standard deviations, at least 0: take the exponential of log scales")
    fits = np.logical_and(opacity >= 0, opacity <= 1)
    _require(fits, opacity, "opacity", "0 to 1: activate a 3DGS file's logits, 1 / (1 + exp(-x))")
    length = np.linalg.norm(rotation.astype(np.float64), axis=1)
    fits = np.isclose(length, 1, rtol=0, atol=UNIT_TOLERANCE)
    _require(fits, rotation, "rotation", "unit quaternions wxyz: divide each by its length")


def _require(fits: NDArray[np.bool_], values: FloatArray, name: str, expected: str) -> None:
    if not fits.all():
        row = int(np.argmin(fits))
        raise SceneError(f"{name} of Gaussian {row} is {values[row].tolist()}; expected {expected}")


@dataclass(frozen=True, eq=False)
class Scene:
    """Points and their views, from any iterable. feature_space: name of the mask features' encoder, e.g.
    ``clip-vit-b32``."""

    points: Points
    views: tuple[View, ...]
    feature_space: str
    name: str = "scene"

    __repr__ = brief

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views or ()))
        if not self.views:
            raise SceneError("the scene has 0 views; expected at least one posed image with a mask")
        parts: list[tuple[Any, type]] = [(self.points, Points), *((view, View) for view in self.views)]
        for value, kind in [*parts, (self.feature_space, str)]:
            if not isinstance(value, kind):
                raise SceneError(
                    f"a scene is given {value!r:.60}; expected {kind.__name__}: Scene(points, views, feature_space) "
                    "takes what Points.from_world(xyz) gives, views, and the name of the features' encoder"
                )
        if not len(self.points):
            raise SceneError("the scene has 0 points; expected at least one: check the geometry")
        widths = {view.mask_features.shape[1]: view.name for view in self.views if view.mask_count}
        if len(widths) > 1:
            odd = next(f"{name}: {width}" for width, name in widths.items() if width != self.feature_width)
            raise SceneError(
                f"mask features have {len(widths)} dimensions {sorted(widths)} (e.g. {odd}); expected one dimension: "
                "encode all masks with the same model"
            )
        # Views are identified by name wherever something about them is stored: work folders, tables, messages.
        names = [view.name for view in self.views]
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise SceneError(f"two views are named '{twice}'; expected unique image names")

    @property
    def feature_width(self) -> int:
        """Width D of the mask features; 0 where no view has a mask."""
        return next((view.mask_features.shape[1] for view in self.views if view.mask_count), 0)
