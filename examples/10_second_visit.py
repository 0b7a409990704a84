"""A map that grows frame by frame, and a second visit: what was moved, what left, what came.

python examples/10_second_visit.py -o OUT    writes changes.png and growing.png, and room.ogpc
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from og_pointcloud_room.second_visit import NAMES, TwoDays

import og_pointcloud as og
from og_pointcloud.formats.colors import label_colors
from og_pointcloud.formats.images import write_png
from og_pointcloud.mapping.map_objects import MapObject
from og_pointcloud.scene import Points
from og_pointcloud.show.drawing import as_splats, draw
from og_pointcloud.show.viewpoint import Viewpoint

SIZE, STRIP, FONT, GRAY = (800, 640), (400, 320), cv2.FONT_HERSHEY_SIMPLEX, (50, 50, 50)
GONE, NEW, MOVED = (200, 60, 50), (40, 150, 70), (40, 90, 200)

parser = argparse.ArgumentParser(description="A map that grows, and a second visit.")
parser.add_argument("-o", "--output", type=Path, default=Path("out/10"), metavar="OUT", help="folder")
parser.add_argument("--frames", type=int, default=60, metavar="N", help="of each visit (default: %(default)s)")
arguments = parser.parse_args()
out = arguments.output
out.mkdir(parents=True, exist_ok=True)
days = TwoDays(frames=arguments.frames)
room, up = np.array(days.room.size), np.array([0.0, 0, 1])
camera = Viewpoint(np.array([-0.3, -0.75, 1.75]) * room, 0.2 * up, up).camera(*SIZE, 800)


def drawn(scene: og.LabelledScene, rgb: np.ndarray, size: tuple[int, int] = SIZE) -> np.ndarray:
    """The room from above, without its ceiling and the walls in front of the eye. rgb: (n, 3), 0 to 255."""
    x, y, z = scene.xyz.T
    shown = (x > 0.08 - room[0] / 2) & (y > 0.08 - room[1] / 2) & (z < room[2] - 0.3)
    points = Points(scene.cloud.xyz[shown], scene.cloud.origin)
    return draw(as_splats(points, scene.cloud.spacing), camera.resized(*size), rgb[shown])


def tinted(scene: og.LabelledScene, tints: Mapping[int, Sequence[int]]) -> np.ndarray:
    """(n, 3) colors: objects in their tint, the rest pale."""
    rgb = 0.55 * np.asarray(scene.cloud.rgb) + 95
    for k, tint in tints.items():
        rgb[scene.instance_ids == k] = tint
    return rgb


def written(image: np.ndarray, entry: MapObject, what: str, color: tuple[int, int, int]) -> None:
    """Writes above an object what it is, and what happened to it."""
    ((u, v),), _ = camera.project(np.array([[*entry.place[:2], entry.box.high[2] + 0.05]]))
    text = f"{name_of(entry)} {what}"
    for thickness, shade in ((6, (255, 255, 255)), (2, color)):
        cv2.putText(image, text, (round(u) - 6 * len(text), round(v) - 12), FONT, 0.7, shade, thickness, cv2.LINE_AA)


def name_of(entry: MapObject) -> str:
    """The word that fits an object best."""
    return NAMES[int((days.model.texts @ np.asarray(entry.descriptor)).argmax())]


# Monday: the map grows frame by frame; four pictures on the way.
mapper, strip = og.Mapper(feature_space=days.feature_space), []
for number, frame in enumerate(days.before, 1):
    mapper.integrate(frame)
    if number in {round(len(days.before) * share) for share in (0.1, 0.3, 0.6, 1.0)}:
        scene = mapper.snapshot()
        by_object = label_colors(np.arange(len(scene.cloud.instances))).tolist()
        strip.append(drawn(scene, tinted(scene, dict(enumerate(by_object))), STRIP))
        text = f"{number} frames, {len(mapper.objects())} objects"
        cv2.putText(strip[-1], text, (12, 308), FONT, 0.55, GRAY, 1, cv2.LINE_AA)
write_png(out / "growing.png", np.hstack(strip))
monday, before = mapper.snapshot(), {entry.id: entry for entry in mapper.objects()}

# Tuesday: the same mapper goes on. Objects keep their ids, so that two lists of them show what happened to each.
for frame in days.after:
    mapper.integrate(frame)
tuesday, after = mapper.snapshot(), {entry.id: entry for entry in mapper.objects()}
start = days.after[0].stamp or 0.0
gone = [k for k in before if k in after and after[k].state == "gone"]
moved = [k for k in before if k in after and after[k].state == "moved"]
new = [k for k in after if k not in before and start <= after[k].since < np.inf]

# Left: what is gone, as seen on Monday. Right: what is new or was moved, as seen on Tuesday.
left = drawn(monday, tinted(monday, dict.fromkeys(gone, GONE)))
right = drawn(tuesday, tinted(tuesday, dict.fromkeys(new, NEW) | dict.fromkeys(moved, MOVED)))
for k in gone:
    written(left, before[k], "gone", GONE)
for k in new:
    written(right, after[k], "new", NEW)
for k in moved:
    start_px, end_px = camera.project(np.array([before[k].place, after[k].place]))[0].round().astype(int).tolist()
    cv2.arrowedLine(right, start_px, end_px, (255, 255, 255), 7, cv2.LINE_AA, tipLength=0.1)
    cv2.arrowedLine(right, start_px, end_px, MOVED, 3, cv2.LINE_AA, tipLength=0.1)
    written(right, after[k], "moved", MOVED)
for image, day in ((left, "Monday"), (right, "Tuesday")):
    cv2.putText(image, day, (16, 34), FONT, 0.9, GRAY, 2, cv2.LINE_AA)
write_png(out / "changes.png", np.hstack([left, right]))
mapper.save(out / "room.ogpc")
print(f"gone: {[name_of(before[k]) for k in gone]}, new: {[name_of(after[k]) for k in new]}, "
      f"moved: {[name_of(after[k]) for k in moved]}; truth: {days.changed}")  # fmt: skip
print(f"wrote {out / 'growing.png'}, {out / 'changes.png'} and {out / 'room.ogpc'}")
