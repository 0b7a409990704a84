"""A drawn scene -> a capture folder with exact truth, in the usual capture formats.

Clouds are sampled on the surfaces themselves, so that density, noise, outliers and floaters are as drawn; masks and
features are made as for the demo. Points that noise moved to where another surface is nearer have no truth.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from og_pointcloud_room.capture import (
    FLYING,
    CaptureSettings,
    RoomCapture,
    everyday_vectors,
    ground_truth,
    make_capture,
    mask_features,
    stream,
    write_capture,
)
from og_pointcloud_room.features import FeatureModel
from og_pointcloud_room.furniture import Item
from og_pointcloud_room.masks import MaskNoise, propose_masks
from og_pointcloud_room.raycast import Frame, Intrinsics, RayCaster, Surfaces
from og_pointcloud_room.room import Room
from scipy.spatial import cKDTree

from og_pointcloud_zoo.draws import Draw
from og_pointcloud_zoo.outdoors import Raw
from og_pointcloud_zoo.places import ALIKE, GLASS, MIRROR, PLACES, Sensor

TESTS = str(Path(__file__).parents[2] / "tests")
SHELL = ("floor", "wall", "ceiling")
GHOSTS = 0.05
"""Share of points that a depth sensor measures in a mirror."""
CLOUD, TEXTURE, PATH, MASKS, FEATURES, WORDS = range(6)
"""Random number streams of a scene."""
SMALL = ("mug", "book", "bottle", "vase", "cushion", "potted plant", "lamp", "monitor", "picture")
Doubles = NDArray[np.float64]
Owners = NDArray[np.int32]


def made_scene(draw: Draw, cache: Path) -> Path:
    """The folder of a scene, made if it is missing; complete or not at all."""
    folder = cache / draw.name
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{draw.name}.", dir=cache))
        try:
            write_capture(drawn_capture(draw), temporary)
            temporary.rename(folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return folder


def drawn_capture(draw: Draw) -> RoomCapture:
    """A scene with its truth, in memory."""
    if draw.place == "street":
        return _street(draw)
    if draw.place == "demo":
        settings = CaptureSettings(views=draw.views, width=draw.width, height=draw.height, depth_noise=1 + draw.noise)
        return make_capture(draw.seed, settings)
    return _place(draw)


def _place(draw: Draw) -> RoomCapture:
    rng = stream(draw.seed, CLOUD)
    place = PLACES[draw.place](rng, draw.seed)
    room = place.room
    if draw.all_masked:
        room = Room(room.size, (*room.objects, *room.shell), ())
    intrinsics = Intrinsics(draw.width, draw.height, 0.82 * draw.width)
    # A depth sensor looks through glass: the cloud shows the room without it, photographs may show it.
    sensed = _without(room, [k for k, item in enumerate(room.objects) if item.name == GLASS])
    caster = RayCaster(sensed, stream(draw.seed, TEXTURE))
    poses = place.poses(draw.views, caster.surfaces, stream(draw.seed, PATH))
    sensed_frames = [caster.look(intrinsics, pose) for pose in poses]
    frames = _shown(draw, room, intrinsics, sensed_frames)
    sensor = place.sensor(sensed_frames, intrinsics) if place.sensor else _Sampler(sensed, draw.backdrop)
    xyz, rgb, source, views = _cloud(draw, sensor, sensed, caster.surfaces, sensed_frames, intrinsics, rng)
    instance, background = ground_truth(sensed, caster.surfaces, xyz, source)
    within = np.append([item.name in place.soft for item in room.objects], [False, False])  # and FLYING, BACKGROUND
    instance = np.where(within[source], source, instance)
    names = place.names
    class_of = np.array([names.index(item.name) for item in room.objects], np.int32)
    masked = _masked(draw, room, frames, intrinsics)
    feature_rng, word_rng = stream(draw.seed, FEATURES), stream(draw.seed, WORDS)
    model = FeatureModel(len(names), feature_rng)
    looks = np.stack([model.object_look(feature_rng) for _ in room.objects])
    named = _named(draw, class_of, names, len(masked))
    features = tuple(
        mask_features(ids, frame.owner, named[view], looks, model, draw.wrong_class, stream(draw.seed, FEATURES, view))
        for view, (frame, ids) in enumerate(masked)
    )
    cls = np.where(instance >= 0, class_of[instance], -1).astype(np.int32)
    return RoomCapture(
        room, intrinsics, tuple(frame for frame, _ in masked), tuple(ids for _, ids in masked), features, model.texts,
        xyz, rgb, cls, instance, background & (views > 0), everyday_vectors(model, names, word_rng),
        model.words(50, word_rng), names, views,
    )  # fmt: skip


def _named(draw: Draw, class_of: Owners, names: tuple[str, ...], views: int) -> Owners:
    """(views, objects) the class that an encoder takes each object for: its own, or one alike."""
    found = np.repeat(class_of[None], views, axis=0)
    if draw.confused:
        rng = stream(draw.seed, FEATURES, 0, 0)
        for k, own in enumerate(class_of):
            others = [name for group in ALIKE if names[own] in group for name in group if name in names]
            others = [names.index(name) for name in others if name != names[own]] or [own]
            wrong = rng.random(views) < 2 * draw.confused * rng.random()
            found[wrong, k] = rng.choice(others, int(wrong.sum()))  # a class without one alike stays what it is
    return found


def _without(room: Room, gone: list[int]) -> Room:
    """The room with some objects moved far below its floor, where no camera sees them; all keep their numbers."""
    objects = [item.moved((0, 0, -100)) if k in gone else item for k, item in enumerate(room.objects)]
    return replace(room, objects=tuple(objects))


def _shown(draw: Draw, room: Room, intrinsics: Intrinsics, frames: list[Frame]) -> list[Frame]:
    """The frames with what photographs show differently from the depth sensor: panes, and things taken away."""
    rng, shown = stream(draw.seed, TEXTURE, 1), list(frames)
    if any(item.name == GLASS for item in room.objects):
        pane = RayCaster(room, stream(draw.seed, TEXTURE))
        for view, frame in enumerate(frames):
            if rng.uniform() < 0.5:  # a proposer masks the pane or what is behind it
                shown[view] = replace(frame, owner=pane.look(intrinsics, frame.camera_to_world).owner)
    if draw.taken:
        small = [k for k, item in enumerate(room.objects) if item.name in (*SMALL, "chair")]
        later = RayCaster(_without(room, rng.permutation(small)[: draw.taken].tolist()), stream(draw.seed, TEXTURE))
        for view in range(len(frames) // 2, len(frames)):
            shown[view] = later.look(intrinsics, frames[view].camera_to_world)
    return shown


# Masks ----------------------------------------------------------------------------------------------------------


def _masked(
    draw: Draw, room: Room, frames: list[Frame], intrinsics: Intrinsics
) -> list[tuple[Frame, NDArray[np.uint16]]]:
    """Frames with their masks; with levels, each frame three times."""
    # The object whose mask each pixel is in: things alone; with levels also parts, and things with what stands on them.
    noise = MaskNoise(
        draw.split, draw.merge, draw.miss, draw.spurious, draw.wrong_class, draw.edge_px, swallow=draw.swallow
    )
    blurred = stream(draw.seed, MASKS).random(len(frames)) < draw.blurred
    noises = [_blurred(noise) if moves else noise for moves in blurred]
    owners = [[_together(room, draw.spans)[frame.owner]] for frame in frames]
    if draw.levels:
        parts = [Item(item.name, (part,)) for item in room.objects for part in item.parts]
        caster = RayCaster(replace(room, objects=tuple(parts)), stream(draw.seed, TEXTURE))
        whole = _together(room, len(room.objects))
        for view, frame in enumerate(frames):
            owners[view] += [caster.look(intrinsics, frame.camera_to_world).owner, whole[frame.owner]]
    return [
        (frame, propose_masks(owner, noises[view], stream(draw.seed, MASKS, view, level)))
        for view, (frame, levels) in enumerate(zip(frames, owners, strict=True))
        for level, owner in enumerate(levels)
    ]


def _blurred(noise: MaskNoise) -> MaskNoise:
    """The mask noise of a view taken in motion: edges wander four times as far, more masks are missing or joined."""
    return replace(noise, edge_px=4 * noise.edge_px, miss=noise.miss + 0.25, merge=noise.merge + 0.1)


def _together(room: Room, spans: int) -> Owners:
    """(objects + 1,) the object whose mask each object is in: for the first ``spans`` small things the one beside them,
    for the others their own. The last entry stands for pixels without a mask."""
    owner = np.append(np.arange(len(room.objects)), -1).astype(np.int32)
    middle = np.array([item.vertices.mean(axis=0) for item in room.objects])
    large = [k for k, item in enumerate(room.objects) if item.name not in (*SMALL, *SHELL)]
    for thing in [k for k, item in enumerate(room.objects) if item.name in SMALL][:spans] if large else []:
        owner[thing] = large[int(np.argmin(((middle[large] - middle[thing]) ** 2).sum(axis=1)))]
    return owner


# The cloud ------------------------------------------------------------------------------------------------------


def _cloud(
    draw: Draw, sensor: Sensor, room: Room, surfaces: Surfaces, frames: list[Frame], intrinsics: Intrinsics,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], Owners, Owners]:  # fmt: skip
    """xyz (n, 3), rgb (n, 3) uint8, the object that each point was sampled on, and how many frames see it there."""
    mirrors = np.flatnonzero([item.name == MIRROR for item in room.objects])
    shares = {"outliers": draw.outliers, "floaters": draw.floaters, "ghosts": GHOSTS if len(mirrors) else 0}
    extra = {name: int(share * draw.points) for name, share in shares.items()}
    # Samples are drawn in batches until enough are kept: those in the room, thinned towards its walls, and seen by a
    # view or, by chance, kept though hidden.
    wanted, kept = draw.points - sum(extra.values()), []
    for _ in range(200):
        xyz, normal, owner, rgb, offset = sensor(max(draw.points, 10_000), rng)
        half = np.array([room.size[0] / 2, room.size[1] / 2])
        inside = (np.abs(xyz[:, :2]) <= half + 1e-6).all(axis=1) & (xyz[:, 2] >= -1e-6) & (xyz[:, 2] <= room.size[2])
        thinning = np.exp(-draw.uneven * np.sqrt((xyz[:, :2] ** 2).sum(axis=1) / (half**2).sum()))
        chance = rng.random((2, len(xyz)))
        keep = inside & (chance[0] < thinning)
        views = np.zeros(len(xyz), np.int32)
        views[keep] = _views(xyz[keep], frames, intrinsics, surfaces)
        keep &= (views > 0) | (chance[1] < draw.hidden)
        kept.append([values[keep] for values in (xyz, normal, owner, rgb, offset, views)])
        if sum(len(part[0]) for part in kept) >= wanted:
            break
    xyz, normal, owner, rgb, offset, views = (np.concatenate(column)[:wanted] for column in zip(*kept, strict=True))
    # Noise is in spacings of the things' points, as in a fit's settings: the mean distance to the three nearest.
    things = xyz[owner >= 0] if (owner >= 0).any() else xyz
    to_others: Doubles = np.asarray(cKDTree(things).query(things[:20_000], 4)[0])[:, 1:]
    spacing = float(np.median(to_others.mean(axis=1)))
    xyz = xyz + draw.noise * spacing * rng.normal(size=(len(xyz), 1)) * normal + offset
    anywhere = rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 1), (extra["outliers"], 3)) * room.size
    flying = np.concatenate([anywhere, _floaters(frames, intrinsics, extra["floaters"], rng),
                             _ghosts(room, frames, intrinsics, mirrors, extra["ghosts"], rng)])  # fmt: skip
    order = rng.permutation(len(xyz) + len(flying))
    return (
        np.concatenate([xyz, flying])[order].astype(np.float32),
        np.concatenate([rgb, rng.integers(0, 256, (len(flying), 3), np.uint8)])[order],
        np.append(owner, np.full(len(flying), FLYING))[order].astype(np.int32),
        np.append(views, np.zeros(len(flying)))[order].astype(np.int32),
    )


class _Sampler:
    """Random points on a room's surfaces, uniform except for ``backdrop``; none on mirrors."""

    def __init__(self, room: Room, backdrop: float) -> None:
        corners, owner, color, weight = [], [], [], []
        items = [*enumerate(room.objects), *((-1, item) for item in room.shell)]
        for index, item in items:
            density = backdrop if item.name in SHELL else float(item.name != MIRROR)
            for part in item.parts:
                corners.append(part.vertices[part.triangles])
                count = len(part.triangles)
                owner.append(np.full(count, index))
                color.append(np.broadcast_to([part.material.color, part.material.second], (count, 2, 3)))
                weight.append(np.full(count, density))
        self.corners, self.owner, self.color, weights = map(np.concatenate, (corners, owner, color, weight))
        across = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        length = np.sqrt((across**2).sum(axis=1))  # twice the triangle's area
        self.normal = across / np.maximum(length, 1e-12)[:, None]
        self.reach = np.cumsum(length * weights)

    def __call__(self, count: int, rng: np.random.Generator) -> Raw:
        """``count`` points, without noise."""
        triangle = np.minimum(np.searchsorted(self.reach, rng.random(count) * self.reach[-1]), len(self.reach) - 1)
        a, b = np.sqrt(rng.random(count)), rng.random(count)  # uniform over a triangle: a runs from its first corner
        first, second, third = self.corners[triangle].transpose(1, 0, 2)
        xyz = (1 - a)[:, None] * first + (a * (1 - b))[:, None] * second + (a * b)[:, None] * third
        blend = rng.random((count, 1))
        color = self.color[triangle]
        rgb = 255 * np.sqrt(0.6 * (blend * color[:, 0] + (1 - blend) * color[:, 1]))
        return Raw(xyz, self.normal[triangle], self.owner[triangle], rgb.astype(np.uint8), np.zeros_like(xyz))


def _views(
    xyz: Doubles | NDArray[np.float32], frames: list[Frame], intrinsics: Intrinsics, surfaces: Surfaces | None = None
) -> Owners:
    """(n,) how many frames see each point: it is in the image, and no surface is in front of it; or, without surfaces,
    it is no deeper than what its pixel shows."""
    # Sums are written out, as the last bit of matrix products depends on the processor.
    count, half = np.zeros(len(xyz), np.int32), np.array([intrinsics.width / 2, intrinsics.height / 2])
    points = np.asarray(xyz, np.float64)
    for frame in frames:
        pose = frame.camera_to_world
        shifted = points - pose[:3, 3]
        depth, across, down = (
            shifted[:, 0] * pose[0, k] + shifted[:, 1] * pose[1, k] + shifted[:, 2] * pose[2, k] for k in (2, 0, 1)
        )
        front = np.maximum(depth, 1e-6)
        column = np.floor(np.clip(intrinsics.focal_px * across / front + half[0], -1, intrinsics.width)).astype(int)
        row = np.floor(np.clip(intrinsics.focal_px * down / front + half[1], -1, intrinsics.height)).astype(int)
        inside = np.flatnonzero(
            (depth > 0.05) & (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
        )
        if surfaces is None:
            count[inside] += depth[inside] < 1.02 * frame.depth_m[row[inside], column[inside]] + 0.01
        else:
            steps = shifted[inside]
            # The ray ends 2 mm before the point, as its own surface would hide it.
            clear = 1 - 2e-3 / np.sqrt((steps**2).sum(axis=1))
            start = np.broadcast_to(pose[:3, 3], steps.shape)
            count[inside] += ~surfaces.is_blocked(start, steps * clear[:, None])
    return count


def _floaters(frames: list[Frame], intrinsics: Intrinsics, count: int, rng: np.random.Generator) -> Doubles:
    """(count, 3) points between cameras and what a random pixel of them sees."""
    view, pixel, share = rng.random((count, 3)).T
    directions = intrinsics.directions().reshape(-1, 3)
    view, pixel = (view * len(frames)).astype(int), (pixel * len(directions)).astype(int)
    xyz = np.zeros((count, 3))
    for index, (frame, at) in enumerate(zip(view, pixel, strict=True)):
        pose = frames[frame].camera_to_world
        ray = (pose[:3, :3] * directions[at]).sum(axis=1)
        xyz[index] = pose[:3, 3] + (0.15 + 0.7 * share[index]) * frames[frame].depth_m.ravel()[at] * ray
    return xyz


def _ghosts(
    room: Room, frames: list[Frame], intrinsics: Intrinsics, mirrors: NDArray[np.int64], count: int,
    rng: np.random.Generator,
) -> Doubles:  # fmt: skip
    """(count or fewer, 3) points behind a mirror that faces -y, where a depth sensor puts what it reflects."""
    if not count:
        return np.zeros((0, 3))
    surfaces = Surfaces([*room.objects, *room.shell])
    seen = [np.flatnonzero((frame.owner == mirrors[0]).ravel()) for frame in frames]
    directions, found = intrinsics.directions().reshape(-1, 3), []
    for frame, pixels in zip(frames, seen, strict=True):
        at = pixels[(rng.random(count // len(frames) + 1) * len(pixels)).astype(int)] if len(pixels) else pixels
        pose = frame.camera_to_world
        ray = (pose[:3, :3] * directions[at][:, None]).sum(axis=2)
        touch = pose[:3, 3] + frame.depth_m.ravel()[at][:, None] * ray
        # The reflected ray gives the distance; the sensor puts the point straight ahead, behind the mirror.
        back = ray * (1, -1, 1)
        for start, turned, straight in zip(touch, back, ray, strict=True):
            far = surfaces.cast(start + 1e-3 * turned, turned[None]).distance[0]
            found.append(start + far * straight)
    return np.array(found).reshape(-1, 3)[:count]


# The street -----------------------------------------------------------------------------------------------------


def _street(draw: Draw) -> RoomCapture:
    """The tests' street, seen from a car; its road and pavement are known background."""
    if TESTS not in sys.path:
        sys.path.append(TESTS)
    from street import CLASSES, FARTHEST_M, Street, make_street  # pyright: ignore[reportMissingImports]

    length = 10.0 + 1.6 * draw.views
    made = make_street(draw.points, draw.views, (draw.width, draw.height), length, draw.seed)
    street = Street.build(length, np.random.default_rng(draw.seed))
    intrinsics, frames = Intrinsics(draw.width, draw.height, 0.6 * draw.width), []
    for view in made.scene.views:
        owner, depth = street.look(view.camera)
        pose = np.linalg.inv(view.camera.world_to_camera)
        frames.append(Frame(pose, np.minimum(depth, FARTHEST_M), owner.astype(np.int32), street.image(view.camera)))
    points, owner = made.scene.points, made.owner.astype(np.int32)
    views = _views(points.xyz, frames, intrinsics)
    # The street's own texts are the first thing that its generator draws after the things and the points.
    rng = np.random.default_rng(draw.seed)
    Street.build(length, rng).points(draw.points, rng)
    model = FeatureModel(len(CLASSES), rng)
    assert points.rgb is not None
    return RoomCapture(
        Room((length, 20.0, 12.0), (), ()), intrinsics, tuple(frames),
        tuple((view.mask_map() + 1).astype(np.uint16) for view in made.scene.views),
        tuple(view.mask_features for view in made.scene.views), model.texts, points.xyz, points.rgb,
        np.where(owner >= 0, street.cls[owner], -1).astype(np.int32), owner, (owner < 0) & (views > 0),
        everyday_vectors(model, CLASSES, stream(draw.seed, WORDS)), model.words(50, stream(draw.seed, WORDS, 1)),
        CLASSES, views,
    )  # fmt: skip
