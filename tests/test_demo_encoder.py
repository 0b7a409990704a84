"""The demo encoder: what is committed knows a room that it was not trained on, and its script makes the same again."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from og_pointcloud.masking.encode import DEMO_SPACE, open_encoder
from og_pointcloud.text.encoder import DEMO_ENCODER, encoder_for, find_encoder

pytest.importorskip("open3d")

from og_pointcloud_room.capture import CaptureSettings, make_capture
from og_pointcloud_room.furniture import CLASS_NAMES
from og_pointcloud_room.words import RELATED, SYNONYMS

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
UNSEEN_ROOM = 2004
ABSENT = (
    "bicycle",
    "guitar",
    "elephant",
    "traffic light",
    "shark",
    "helicopter",
    "pizza",
    "violin",
    "snowman",
    "tractor",
)


@pytest.fixture(scope="module")
def seen():
    """Vectors of the masks of three views of a room that training has not seen, and their classes."""
    capture = make_capture(UNSEEN_ROOM, CaptureSettings(views=3, samples_per_view=20, mask_noise=0))
    encoder, vectors, classes = open_encoder("demo"), [], []
    for frame, ids in zip(capture.frames, capture.masks, strict=True):
        masks = np.arange(1, ids.max() + 1)[:, None, None] == ids
        vectors.append(encoder.embed(frame.image, masks))
        classes += [
            CLASS_NAMES.index(capture.room.objects[np.bincount(frame.owner[mask]).argmax()].name) for mask in masks
        ]
    return np.concatenate(vectors), np.array(classes)


def _right(seen, names):
    vectors, classes = seen
    return ((vectors @ encoder_for(DEMO_SPACE)(names).T).argmax(axis=1) == classes).mean()


def test_it_is_small_and_named_for_what_it_is():
    assert sum(path.stat().st_size for path in DEMO_ENCODER.rglob("*") if path.is_file()) < 1_000_000
    assert open_encoder("demo").feature_space == find_encoder(DEMO_SPACE).feature_space == DEMO_SPACE
    assert "demo" in DEMO_SPACE


def test_it_is_found_without_a_setting(tmp_path, monkeypatch):
    monkeypatch.delenv("OG_POINTCLOUD_MODELS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert find_encoder(DEMO_SPACE) is not None
    assert find_encoder("openai/clip-vit-base-patch16") is None


def test_it_knows_the_things_of_a_room_it_has_not_seen(seen):
    assert _right(seen, CLASS_NAMES) > 0.75
    synonyms = [SYNONYMS[name][1] for name in CLASS_NAMES]
    assert _right(seen, synonyms) > 0.7
    assert _right(seen, [f"a photo of a {name}" for name in CLASS_NAMES]) > 0.7
    assert _right(seen, CLASS_NAMES[1:] + CLASS_NAMES[:1]) < 0.2, "by the words, not by their order"


def test_words_for_nothing_in_the_room_find_nothing(seen):
    vectors, _ = seen
    words = encoder_for(DEMO_SPACE)
    own = (vectors @ words(CLASS_NAMES).T).max(axis=1, keepdims=True)
    assert (vectors @ words(ABSENT).T > own).mean() < 0.02
    assert not set(ABSENT) & set(RELATED)


def test_its_vectors_are_of_this_machine_as_of_any(seen):
    """Unit rows, the same whichever masks are encoded with a mask."""
    capture = make_capture(UNSEEN_ROOM, CaptureSettings(views=1, width=160, height=120, samples_per_view=50))
    masks = np.arange(1, capture.masks[0].max() + 1)[:, None, None] == capture.masks[0]
    encoder, image = open_encoder("demo"), capture.frames[0].image
    together = encoder.embed(image, masks)
    alone = np.concatenate([encoder.embed(image, mask[None]) for mask in masks])
    assert np.abs(together - alone).max() < 1e-5
    assert np.allclose(np.linalg.norm(seen[0], axis=1), 1, atol=1e-5)


@pytest.mark.slow
@pytest.mark.release
def test_its_script_makes_the_same_weights_from_the_same_seed(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnxscript")
    monkeypatch.syspath_prepend(str(EXAMPLES.parent / "scripts"))
    import train_demo_encoder as script

    torch.set_num_threads(1)
    words = script.Words.drawn(np.random.default_rng(0))
    for run, crops in (("first", script.room_crops(1000, 1)), ("second", script.rendered([1000], 1, processes=1))):
        assert crops.proposed.any()
        assert not crops.proposed.all()
        script.export(*script.train(crops, words, steps=2, seed=3), words, tmp_path / run)
    files = [path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*") if path.is_file()]
    assert len(files) == 6
    for file in files:
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes(), file
    assert not set(words.absent) & {word for names in SYNONYMS.values() for word in names}
    sys.modules.pop("train_demo_encoder")


@pytest.mark.slow
@pytest.mark.parametrize("proposer", ["truth", "opencv"])
def test_a_coarse_room_from_photographs_alone(proposer, tmp_path):
    from og_pointcloud_room.capture import write_capture
    from og_pointcloud_room.photographs import label_from_photographs

    settings = CaptureSettings(views=10, width=240, height=180, samples_per_view=6000, voxel_m=0.06, mask_noise=0)
    capture = write_capture(make_capture(UNSEEN_ROOM, settings), tmp_path / "capture")
    masks = str(capture / "masks") if proposer == "truth" else "opencv"
    result = label_from_photographs(capture, tmp_path / "out", masks)
    assert result.masks > 0
    assert result.score.miou > (0.3 if proposer == "truth" else 0.05)
    assert (result.result.labels >= 0).any()
