"""A map that grows frame by frame, and a second visit: what was moved, what left, what came.

python examples/10_second_visit.py -o OUT    writes changes.png and growing.png, and room.ogpc
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from og_pointcloud_room.second_visit import NAMES, TwoDays

import og_pointcloud as og
from og_pointcloud.mapping.map_objects import MapObject
from og_pointcloud.rendering.geometry import isotropic
from og_pointcloud.rendering.splatting import render
from og_pointcloud.scene import Points
from og_pointcloud.show.viewpoint import Viewpoint

SIZE, STRIP, FONT = (800, 640), (400, 320), cv2.FONT_HERSHEY_SIMPLEX
COLORS = {"gone": (200, 60, 50), "new": (40, 150, 70), "moved": (40, 90, 200)}

parser = argparse.ArgumentParser(description="A map that grows, and a second visit.")
parser.add_argument("-o", "--output", type=Path, default=Path("out/10"), metavar="OUT", help="folder")
parser.add_argument("--frames", type=int, default=60, metavar="N", help="of each visit (default: %(default)s)")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
days = TwoDays(frames=arguments.frames)

eye, up = np.array([-0.3, -0.75, 1.75]) * days.room.size, np.array([0.0, 0, 1])
camera = Viewpoint(eye, 0.2 * up, up).camera(*SIZE, 800)


def drawn(scene: og.LabelledScene, colors: np.ndarray, size: tuple[int, int] = SIZE) -> np.ndarray:
    """The room from above, without the walls that stand before it. colors: (n, 3), 0 to 255."""
    low, high = -np.array(days.room.size) / 2 + 0.08, np.array(days.room.size) / 2
    shown = (scene.xyz[:, 0] > low[0]) & (scene.xyz[:, 1] > low[1]) & (scene.xyz[:, 2] < 2 * high[2] - 0.3)
    xyz = scene.xyz[shown].astype(np.float32)
    splats = isotropic(Points(xyz, np.zeros(3)), np.full(len(xyz), scene.cloud.spacing, np.float32), 0.6, 0.95)
    image, covered = render(splats, np.asarray(colors, np.float32)[shown], camera.resized(*size), near=0.1)
    return np.clip(image + 255 * (1 - covered[..., None]), 0, 255).astype(np.uint8)


def by_object(scene: og.LabelledScene) -> np.ndarray:
    """A color for each object, the rest as it is."""
    palette = np.random.default_rng(3).uniform(60, 230, (1 + scene.instance_ids.max(initial=0), 3))
    return np.where(
        scene.instance_ids[:, None] >= 0, palette[scene.instance_ids], 0.4 * np.asarray(scene.cloud.rgb) + 140
    )


def tinted(scene: og.LabelledScene, ids: list[int], color: tuple[int, int, int]) -> np.ndarray:
    """Some objects in one color, the rest pale."""
    return np.where(np.isin(scene.instance_ids, ids)[:, None], color, 0.55 * np.asarray(scene.cloud.rgb) + 95)


def written(image: np.ndarray, text: str, entry: MapObject, color: tuple[int, int, int]) -> None:
    """Writes a name above an object."""
    ((u, v),), _ = camera.project((entry.place + np.array([0, 0, 0.5 * entry.size[2] + 0.05]))[None])
    for thickness, shade in ((6, (255, 255, 255)), (2, color)):
        cv2.putText(image, text, (round(u) - 6 * len(text), round(v) - 12), FONT, 0.7, shade, thickness, cv2.LINE_AA)


def name_of(entry: MapObject) -> str:
    """The word that fits it best."""
    return NAMES[int((days.model.texts @ np.asarray(entry.descriptor)).argmax())]


# Monday: the map grows frame by frame; four pictures on the way.
mapper, strip, moments = og.Mapper(feature_space=days.feature_space), [], []
quarters = {round(len(days.before) * share) - 1 for share in (0.1, 0.3, 0.6, 1.0)}
for number, frame in enumerate(days.before):
    mapper.integrate(frame)
    if number in quarters:
        scene = mapper.snapshot()
        strip.append(drawn(scene, by_object(scene), STRIP))
        cv2.putText(strip[-1], f"{number + 1} frames, {len(mapper.objects())} objects", (12, 308),
                    FONT, 0.55, (60, 60, 60), 1, cv2.LINE_AA)  # fmt: skip
cv2.imwrite(str(out / "growing.png"), np.hstack(strip)[:, :, ::-1])

# Tuesday: the same mapper goes on; each frame returns what it found changed, and objects keep their ids.
monday, before = mapper.snapshot(), {entry.id: entry for entry in mapper.objects()}
changes = [mapper.integrate(frame) for frame in days.after]
tuesday, after = mapper.snapshot(), {entry.id: entry for entry in mapper.objects()}
moved = {entry.id: entry for change in changes for entry in change.moved if entry.id in before}
gone = [k for k, entry in after.items() if entry.state == "gone" and k in before]
tuesday_s = days.after[0].stamp or 0.0
new = [k for k, entry in after.items() if k not in before and tuesday_s <= entry.since < np.inf]

# Left what is gone, as Monday saw it; right what is new or was moved, as Tuesday sees it.
left = drawn(monday, tinted(monday, gone, COLORS["gone"]))
is_moved = np.isin(tuesday.instance_ids, [*moved])
right = drawn(tuesday, np.where(is_moved[:, None], COLORS["moved"], tinted(tuesday, new, COLORS["new"])))
for k in gone:
    written(left, f"{name_of(before[k])} gone", before[k], COLORS["gone"])
for k in new:
    written(right, f"{name_of(after[k])} new", after[k], COLORS["new"])
for k, entry in moved.items():
    ends, _ = camera.project(np.array([entry.before, after[k].place]))
    for thickness, shade in ((7, (255, 255, 255)), (3, COLORS["moved"])):
        start, end = (tuple(map(round, point)) for point in ends.tolist())
        cv2.arrowedLine(right, start, end, shade, thickness, cv2.LINE_AA, tipLength=0.1)
    written(right, f"{name_of(after[k])} moved", after[k], COLORS["moved"])
for image, day in ((left, "Monday"), (right, "Tuesday")):
    cv2.putText(image, day, (16, 34), FONT, 0.9, (40, 40, 40), 2, cv2.LINE_AA)
cv2.imwrite(str(out / "changes.png"), np.hstack([left, right])[:, :, ::-1])
mapper.save(out / "room.ogpc")
print(f"gone: {[name_of(before[k]) for k in gone]}, new: {[name_of(after[k]) for k in new]}, "
      f"moved: {[name_of(after[k]) for k in moved]}; truth: {days.changed}")  # fmt: skip
print(f"wrote {out / 'growing.png'}, {out / 'changes.png'} and {out / 'room.ogpc'}")
