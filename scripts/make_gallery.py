"""docs/gallery.md and its pictures: the numbered examples, run on the demo room.

    python scripts/make_gallery.py [--scene out/demo/room.ogpc]     # without a scene, the demo runs first

Pictures are shrunk to WIDTH and written as JPEG, to keep the repository small.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2

from og_pointcloud.cli import main as command

ROOT = Path(__file__).parents[1]
GALLERY = ROOT / "docs" / "gallery"
WIDTH = 1000
QUALITY = 82


@dataclass(frozen=True)
class Exhibit:
    """An example, its arguments ({scene}, {capture}, {splats} and {out} are filled in), and which of its pictures are
    shown."""

    example: str
    arguments: tuple[str, ...]
    pictures: tuple[str, ...]
    seen: str

    def kept_as(self, picture: str) -> str:
        """The picture's file in the gallery."""
        return f"{self.example[:2]}_{Path(picture).stem}.jpg"


EXHIBITS = (
    Exhibit("01_label_a_cloud", ("{scene}", "-o", "{out}"), ("labels.png",), "The room by words."),
    Exhibit("02_instances_and_boxes", ("{scene}", "-o", "{out}"), ("instances.png",), "Objects, and boxes."),
    Exhibit("03_click_query", ("{scene}", "-o", "{out}"), ("before.png", "after.png"), "Before and after a click."),
    Exhibit(
        "05_highlight_in_splats",
        ("{scene}", "{splats}", "chair", "--eye=-1.7,-1.5,1.9", "--target=0.1,0.1,0.4", "-o", "{out}/chairs.png"),
        ("chairs.png",),
        "One word lit in a rendering of the splat.",
    ),
    Exhibit("07_robot", ("--scene", "{scene}", "-o", "{out}"), ("07_robot.png",),
            "A robot drives through the room after a chair was moved and two things were brought in."),
    Exhibit("08_edit_a_scene", ("{scene}", "-o", "{out}"), ("edited.png",),
            "As it was; sofa and cushions removed; the table red; one more chair. White is what no camera ever saw."),
    Exhibit("09_how_sure", ("{scene}", "-o", "{out}"), ("how_sure.png",),
            "Dark is where views or neighbors disagree: borders, and the floor seen between legs."),
    Exhibit("10_second_visit", ("-o", "{out}"), ("growing.png", "changes.png"),
            "The map after 6, 18, 36 and 60 frames; then the next day: the vase left, the ball came, the chair was "
            "moved and keeps its id. White, and the seat below the table, is what no frame looked at."),
    Exhibit("11_paper_figures", ("{capture}", "chair", "-o", "{out}"), ("features.png", "objects.png"),
            "Mode paper in the made room: its features, the leaves of its codebook, and the default way's instances, "
            "in the same colors; gray is what no mask shows. Then a click on a chair: what it selects, what is left "
            "without that, and that painted, of mode paper and of the default way."),
)  # fmt: skip


def main() -> None:
    """Run all, keep the pictures, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="the demo's room.ogpc, beside its capture")
    arguments = parser.parse_args()
    GALLERY.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        scene = arguments.scene or demo(work / "demo")
        # The edited room comes first: another example highlights a word in its splat file.
        order = sorted(EXHIBITS, key=lambda exhibit: exhibit.example != "08_edit_a_scene")
        for exhibit in order:
            print(exhibit.example, flush=True)
            run(exhibit, scene, work)
    (ROOT / "docs" / "gallery.md").write_text(page())
    print(f"wrote {ROOT / 'docs' / 'gallery.md'}")


def demo(folder: Path) -> Path:
    """The demo room, fitted."""
    if command(["demo", "-o", str(folder)]):
        raise SystemExit("the demo failed: what it printed says why")
    return folder / "room.ogpc"


def run(exhibit: Exhibit, scene: Path, work: Path) -> None:
    """Run an example in its own folder, and keep its pictures."""
    out = work / exhibit.example
    out.mkdir(exist_ok=True)
    splats = work / "08_edit_a_scene" / "before.ply"
    places = {"scene": scene, "capture": scene.parent / "capture", "splats": splats, "out": out}
    arguments = [argument.format(**places) for argument in exhibit.arguments]
    subprocess.run([sys.executable, str(ROOT / "examples" / f"{exhibit.example}.py"), *arguments], check=True)
    for name in exhibit.pictures:
        image = cv2.imread(str(out / name))
        assert image is not None, f"{exhibit.example} left no {name}"
        height = round(image.shape[0] * WIDTH / image.shape[1])
        small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(GALLERY / exhibit.kept_as(name)), small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def page() -> str:
    """The page's text: for each example its picture, a caption, and a link to its code."""
    parts = ["# Gallery\n\nThe numbered examples on the demo room, made by `python scripts/make_gallery.py`.\n"]
    for exhibit in EXHIBITS:
        code = (ROOT / "examples" / f"{exhibit.example}.py").read_text()
        title = (ast.get_docstring(ast.parse(code)) or "").splitlines()[0]
        parts.append(f"## {exhibit.example[:2]} {title}\n")
        # The caption is given once, below; the alternative text of a picture is its name.
        for name in exhibit.pictures:
            parts.append(f"![{Path(name).stem.replace('_', ' ')}](gallery/{exhibit.kept_as(name)})")
        parts.append(f"\n{exhibit.seen} [{exhibit.example}.py](../examples/{exhibit.example}.py)\n")
    return "\n".join(parts)


if __name__ == "__main__":
    main()
