"""One word, ten thousand, words of nothing, of emoji, and vectors that say nothing."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hard_cases import naive
from hard_cases.case import Answer, agrees, powers, refuses
from hard_cases.inputs import labelled_cloud, unit_rows
from og_pointcloud.ask.labelled_scene import LabelledScene, Segmenter, load, segment
from og_pointcloud.cloud import LabelledCloud, Vocabulary
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError


@agrees(1e-6, "length of a word's vector", (1e-44, 1e-38, 1e-30, *powers(-20, 20, 10), 1e30, 1e37))
def vector_length(length: float) -> Answer:
    """Scores do not depend on how long the words' vectors are."""
    text = (unit_rows(50, 16, 1).astype(np.float64) * length).astype(np.float32)
    cloud = labelled_cloud()
    descriptors = cloud.instances.descriptors
    return Answer(
        _scene(cloud).cloud.instances.cosines(text), _exact(cloud, text), lambda: naive.cosines(descriptors, text)
    )


@agrees(0, "angle between two words, radians", powers(0, -5, -1))
def nearly_equal_words(angle: float) -> Answer:
    """The right one of two words is chosen, however near; naive: float16 cosines."""
    cloud, random = labelled_cloud(instances=40, width=64), np.random.default_rng(0)
    descriptors = cloud.instances.descriptors
    word = random.normal(size=64)
    other = random.normal(size=64)
    other -= word * (other @ word) / (word @ word)
    other *= np.linalg.norm(word) / np.linalg.norm(other)
    text = np.stack([word, np.cos(angle) * word + np.sin(angle) * other]).astype(np.float32)
    exact = _exact(cloud, text).argmax(axis=1)
    clear = np.abs(np.diff(_exact(cloud, text), axis=1))[:, 0] > 1e-6  # nearer ones are equal in float32
    ours = _scene(cloud).cloud.instances.cosines(text).argmax(axis=1)
    return Answer(ours[clear], exact[clear], lambda: naive.cosines(descriptors, text, np.float16).argmax(axis=1)[clear])


@agrees(0)
def one_word() -> Answer:
    """A single word is the label of every point that has a descriptor, and its score says how well it fits."""
    cloud = labelled_cloud()
    return Answer(segment(cloud, {"chair": unit_rows(1, 16, 1)[0]}).labels, np.zeros(200, np.int32))


@agrees(0)
def ten_thousand_words() -> Answer:
    """10,000 words, against float64."""
    cloud, text = labelled_cloud(), unit_rows(10_000, 16, 1)
    words = Vocabulary(tuple(f"word {i}" for i in range(len(text))), text)
    exact = _exact(cloud, text).argmax(axis=1).astype(np.int32)
    return Answer(Segmenter(cloud, words)(cloud.xyz_world).labels, exact[cloud.instance_ids])


@agrees(0)
def emoji() -> Answer:
    """Words of emoji, of other scripts and of two bytes that look alike, through a file."""
    names = ("🪑", "🪑🏽", "стул", "椅子", "e\u0301", "é")
    cloud = replace(labelled_cloud(), vocabulary=Vocabulary(names, unit_rows(6, 16)))
    scene = _written(cloud)
    exact = _exact(cloud, unit_rows(6, 16)).argmax(axis=1).astype(np.int32)[cloud.instance_ids]
    labels = segment(scene, list(names)).labels
    return Answer(np.r_[labels, scene.vocabulary is not None and scene.vocabulary.names == names], np.r_[exact, True])


@agrees(0)
def no_point_to_ask() -> Answer:
    """A cloud of no point."""
    return Answer(segment(np.zeros((0, 3)), None, _scene(labelled_cloud())).labels, np.zeros(0, np.int32))


@agrees(0)
def instances_without_descriptors() -> Answer:
    """Words are asked of a scene that knows no feature at all: unknown everywhere, whatever the width."""
    cloud = labelled_cloud(descriptors=np.zeros((0, 16), np.float32))
    return Answer(segment(cloud, {"chair": [1.0, 2.0]}).labels, np.full(200, -1, np.int32))


@refuses(OgPointcloudError, "row 0 has an empty name", "expected a word", "name it or remove it")
def empty_word() -> object:
    """The empty string as a word, with a vector."""
    return segment(labelled_cloud(), {"": unit_rows(1, 16)[0]})


@refuses(OgPointcloudError, "a label is empty", "expected words", "name what you want to find")
def empty_word_without_a_vector() -> object:
    """The empty string as a word to look up."""
    return segment(labelled_cloud(), "")


@refuses(FeatureSpaceError, "the vector of 'chair' is zero", "similar to nothing", "encode it again")
def vector_of_zero() -> object:
    """A word whose vector is zero."""
    return segment(labelled_cloud(), {"chair": np.zeros(16)})


@refuses(FeatureSpaceError, "the vector of 'desk' is NaN or infinite", "expected finite", "encode it again")
def vector_not_a_number() -> object:
    """A word whose vector holds NaN."""
    return segment(labelled_cloud(), {"chair": np.ones(16), "desk": np.full(16, np.nan)})


@refuses(FeatureSpaceError, "in feature space 'another'", "expected feature space 'catalogue'", "encode them with")
def words_of_another_space() -> object:
    """Words of another encoder, of the same width."""
    words = Vocabulary(("chair",), unit_rows(1, 16))
    return segment(labelled_cloud(), ["chair"], text_features=(words, "another"))


def _scene(cloud: LabelledCloud) -> LabelledScene:
    return LabelledScene.from_cloud(cloud)


def _written(cloud: LabelledCloud) -> LabelledScene:
    from og_pointcloud_export import write_bundle

    with tempfile.TemporaryDirectory() as folder:
        return load(write_bundle(cloud, Path(folder) / "scene.ogpc"))


def _exact(cloud: LabelledCloud, text: NDArray[np.floating]) -> NDArray[np.float64]:
    """(K, L) float64 cosines of instances, which have one descriptor each, with words."""
    text, rows = text.astype(np.float64), cloud.instances.descriptors.astype(np.float64)
    return rows @ (text / np.linalg.norm(text, axis=1, keepdims=True)).T
