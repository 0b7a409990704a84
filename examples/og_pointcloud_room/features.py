"""Simulated CLIP features: random unit vectors with the cosines that real image-text pairs have.

Measured on real CLIP pairs: text-text 0.74, image-image 0.53, image-text 0.33 where they match and 0.18 where not;
the means of the two modalities lie 0.95 apart. With orthonormal directions T (all texts), J (all images) and u_c
(one per class) that is ::

    text_c  = 0.86 T  + 0.51 u_c
    image   = 0.73 J' + 0.29 u_c + 0.62 noise        J' has cosine 0.29 with T

The noise has three parts: one that all views of an object share, one new in each mask, and one towards other classes,
which makes single masks err while the mean over the views of an object seldom does.

The encoder knows other words too, of the same form with a random direction in place of u_c.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FEATURE_SPACE = "simulated-clip-512"
WIDTH = 512
TEXT_TEXT, IMAGE_IMAGE, MATCHED, UNMATCHED = 0.74, 0.53, 0.33, 0.18
CONFUSION = 0.035
"""Spread of a single mask's cosine with a wrong class, beyond that from unrelated noise."""


class FeatureModel:
    """Draws the features of one room's texts and masks.

    texts: (C, 512) float32, one unit row per class.
    """

    texts: NDArray[np.float32]

    def __init__(self, classes: int, rng: np.random.Generator) -> None:
        # Orthonormal: T, the part of J orthogonal to texts, and u_c of each class.
        basis = np.linalg.qr(rng.normal(size=(WIDTH, classes + 2)))[0].T
        text_common, image_only, self._class_directions = basis[0], basis[1], basis[2:]
        # Weights follow from the cosines: two texts share T, two images J', an image and a wrong text J's part along T.
        text_weight, image_weight = np.sqrt(TEXT_TEXT), np.sqrt(IMAGE_IMAGE)
        shared = UNMATCHED / (text_weight * image_weight)
        self._image_common = image_weight * (shared * text_common + np.sqrt(1 - shared**2) * image_only)
        self._text_class_weight = np.sqrt(1 - TEXT_TEXT)
        self._image_class_weight = (MATCHED - UNMATCHED) / self._text_class_weight
        self._confusion = CONFUSION / self._text_class_weight
        self._text_common = text_weight * text_common
        # The squared length that the other parts leave of a unit vector.
        spent = IMAGE_IMAGE + self._image_class_weight**2 + classes * self._confusion**2
        self._noise_weight = np.sqrt(1 - spent)
        self.texts = (self._text_common + self._text_class_weight * self._class_directions).astype(np.float32)

    def words(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """(count, 512) unit rows: texts of no class."""
        # Orthogonal to T, whose vector here has the squared length TEXT_TEXT.
        own = rng.normal(size=(count, WIDTH))
        own -= np.outer(own @ self._text_common, self._text_common) / TEXT_TEXT
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        return (self._text_common + self._text_class_weight * own).astype(np.float32)

    def object_look(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """(512,) the part of the noise that all views of one object share."""
        return rng.normal(size=WIDTH) / np.sqrt(WIDTH)

    def image(self, class_id: int, look: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """(512,) unit feature of one mask that shows an object of this class and look."""
        confusion = self._confusion * rng.normal(size=len(self._class_directions))
        fresh = rng.normal(size=WIDTH) / np.sqrt(WIDTH)
        rest = self._noise_weight * (np.sqrt(0.4) * look + np.sqrt(0.6) * fresh)
        vector = self._image_common + self._image_class_weight * self._class_directions[class_id]
        vector = vector + rest + confusion @ self._class_directions
        return vector / np.linalg.norm(vector)
