"""What people call the room's things: names for each class, and words too similar to count as right or wrong."""

from __future__ import annotations


def _listed(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.replace("\n", " ").split(","))


SYNONYMS = {name: _listed(words) for name, words in {
    "bed": "bed, single bed, bedstead, guest bed, day bed",
    "book": "book, novel, paperback, hardcover, volume, textbook",
    "bottle": "bottle, wine bottle, glass bottle, water bottle, beer bottle, flask",
    "cabinet": "cabinet, sideboard, cupboard, credenza, dresser, commode",
    "chair": "chair, dining chair, kitchen chair, wooden chair, seat, side chair",
    "cushion": "cushion, pillow, throw pillow, sofa cushion, scatter cushion",
    "desk": "desk, writing desk, office desk, computer desk, work desk, bureau",
    "lamp": "lamp, floor lamp, table lamp, desk lamp, standing lamp, lampshade, light",
    "monitor": "monitor, computer monitor, screen, computer screen, display, flat screen",
    "mug": "mug, cup, coffee mug, coffee cup, tea cup, teacup, beaker",
    "picture": "picture, painting, picture frame, framed picture, artwork, art print, wall art",
    "potted plant": "potted plant, plant, houseplant, house plant, pot plant, indoor plant, plant pot",
    "rug": "rug, carpet, area rug, floor rug, mat",
    "shelf": "shelf, bookshelf, bookcase, book shelf, shelves, shelving unit, rack",
    "sofa": "sofa, couch, settee, loveseat, two-seater, divan",
    "table": "table, dining table, kitchen table, dinner table, wooden table",
    "vase": "vase, flower vase, urn, ceramic vase, amphora",
    "wall": "wall, wallpaper, plaster wall, partition",
    "floor": "floor, wooden floor, floorboards, ground, parquet",
}.items()}  # fmt: skip
"""The first of each is the class's own name; the room's shell has names too."""

RELATED = _listed("""armchair, stool, bench, mattress, blanket, drawer, wardrobe, nightstand, curtain, doormat, poster,
whiteboard, blackboard, bulletin board, calendar, window sill, ceiling light, light bulb, chandelier, television,
laptop, tablet, wine glass, drinking glass, jug, pitcher, thermos, bowl, saucer, teapot, jar, notebook, magazine,
folder, binder, flower, fern, palm tree, bush, leaf, tree, ivy, vine, bonsai, cactus, tile, brick, flowerpot,
watering can, high chair, car seat, crib, perfume bottle, pill bottle, soap dispenser, baby bottle, tablecloth,
yoga mat, placemat, mouse pad, map, lamp post, street light, cooking pot, grass, postcard, letter, soil,
projector screen, plate, tray, cutting board, clipboard, log, wooden post, measuring cup, milk carton, olive oil,
trophy, statue, vinegar, ketchup, tin can, soda can, pillowcase, sidewalk, road, ceiling""")
"""Everyday words that might well name a thing of the room: neither wanted nor counted as mistakes."""
