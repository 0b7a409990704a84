"""Mask encoders: preprocessing, the mean of crops, the opening of encoders, and exported folders that do not fit."""

from __future__ import annotations

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.masking.crops import Crop, Preprocessing, mask_crops
from og_pointcloud.masking.encode import CropEncoder, OnnxModel, open_encoder
from og_pointcloud.text.encoder import DEMO_ENCODER

RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (40, 60, 3), np.uint8)
MASKS = np.zeros((3, 40, 60), bool)
MASKS[0, 5:20, 10:40], MASKS[1, 30:, 50:], MASKS[2] = True, True, True


# Preprocessing


@pytest.mark.slow  # transformers
@pytest.mark.parametrize("side", [640, 91, 224])
@pytest.mark.parametrize("family", ["clip", "siglip"])
def test_preprocessing_is_that_of_the_models_own_processor(family, side):
    """On square images, which crops are: the processors then cut nothing off."""
    transformers = pytest.importorskip("transformers")
    clip = pytest.importorskip("og_pointcloud.masking.clip")
    image = np.random.default_rng(1).integers(0, 256, (side, side, 3), np.uint8)
    image[: side // 2] = image[: side // 2, :1]  # edges and flat parts, not noise alone
    if family == "clip":
        processor, colors = transformers.CLIPImageProcessor(), clip.CLIP_MEAN_STD
    else:
        processor = transformers.SiglipImageProcessor(size={"height": 224, "width": 224}, resample=3)
        colors = clip.SIGLIP_MEAN_STD
    ours = Preprocessing(224, *colors)
    expected = np.asarray(processor(image, return_tensors="np", input_data_format="channels_last")["pixel_values"])
    square = mask_crops(image, np.ones((1, side, side), bool), Crop(), 224)
    levels = np.abs(ours.pixels(square) - expected) * 255 * np.array(ours.std)[:, None, None]
    assert levels.max() < 1.01, "one level of 255 at most"
    assert (levels > 0.5).mean() < 0.005


@pytest.mark.parametrize("file", ["preprocessor_config.json", "processor_config.json"])
def test_preprocessing_is_read_from_either_file_of_transformers(tmp_path, file):
    pytest.importorskip("torch")
    clip = pytest.importorskip("og_pointcloud.masking.clip")
    config = SimpleNamespace(model_type="siglip", vision_config=SimpleNamespace(image_size=32))
    stated = {"image_mean": [0.4] * 3, "image_std": [0.2] * 3, "resample": 2, "rescale_factor": 1 / 255}
    (tmp_path / file).write_text(json.dumps({"image_processor": stated} if file.startswith("processor") else stated))
    assert clip.preprocessing_of(tmp_path, config) == Preprocessing(32, (0.4,) * 3, (0.2,) * 3, "bilinear")


@pytest.mark.parametrize(
    "stated",
    [{"image_mean": None}, {"image_mean": ["a"] * 3}, {"image_mean": [0.5]}, {"image_std": [0, 1, 1]},
     {"image_processor": []}],
)  # fmt: skip
def test_colors_that_are_no_colors_are_refused(tmp_path, stated):
    clip = pytest.importorskip("og_pointcloud.masking.clip")
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stated))
    config = SimpleNamespace(model_type="clip", vision_config=SimpleNamespace(image_size=32))
    with pytest.raises(SceneError, match="image_mean or image_std of its image processor cannot be used"):
        clip.preprocessing_of(tmp_path, config)


# Mask encoders


class MeanColor:
    """An image model that says a square's mean color."""

    feature_space, width, preprocessing = "tests/mean", 3, Preprocessing(8, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    crops = (Crop(),)

    def __init__(self):
        self.runs = []

    def __call__(self, pixels):
        self.runs.append(len(pixels))
        means = pixels.mean(axis=(2, 3)) + 1e-6
        return means / np.linalg.norm(means, axis=1, keepdims=True)


def test_a_masks_vector_is_the_weighted_mean_of_its_crops(monkeypatch):
    monkeypatch.setattr("og_pointcloud.masking.encode.CROPS_PER_RUN", 2)
    model = MeanColor()
    crops = (Crop(1.0, 0.0, 1.0), Crop(2.0, 0.5, 0.25))
    got = CropEncoder(model, crops).embed(IMAGE, MASKS)
    assert model.runs == [2, 1, 2, 1]
    expected = np.zeros((3, 3))
    for row, mask in enumerate(MASKS):
        for crop in crops:
            square = mask_crops(IMAGE, mask[None], crop, 8, (0, 0, 0))
            expected[row] += crop.weight * model(model.preprocessing.pixels(square))[0]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(got - expected).max() < 1e-6
    assert got.dtype == np.float32


def test_no_mask_is_no_row_and_an_empty_mask_an_error():
    encoder = open_encoder("demo")
    assert encoder.embed(IMAGE, MASKS[:0]).shape == (0, encoder.width)
    with pytest.raises(SceneError, match="no pixel"):
        encoder.embed(IMAGE, np.zeros((1, 40, 60), bool))
    with pytest.raises(SceneError, match="0 ways to crop"):
        CropEncoder(MeanColor(), ())


# Opening


def test_an_encoder_is_found_by_its_folder_and_its_name(tmp_path, monkeypatch):
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", "")
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    expected = open_encoder("demo").embed(IMAGE, MASKS)
    folder = exported(tmp_path / "models" / "room", feature_space="tests/room")
    assert (open_encoder(folder).embed(IMAGE, MASKS) == expected).all()
    with pytest.raises(OgPointcloudError, match="hf download tests/room"):
        open_encoder("tests/room")
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(tmp_path / "models"))
    assert (open_encoder("tests/room").embed(IMAGE, MASKS) == expected).all()


def exported(folder, name="manifest.json", edit=None, **fields):
    """The demo encoder's image half with other bytes in a file, or other fields in its manifest."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(DEMO_ENCODER / "image", folder)
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(edit(data) if edit else json.dumps({**json.loads(data), **fields}).encode())
    return folder


def test_an_exported_folder_is_checked_before_it_runs(tmp_path):
    with pytest.raises(OgPointcloudError, match="checksum"):
        OnnxModel(exported(tmp_path / "e", "image_encoder.onnx", lambda data: data[:-1] + b"x"))
    for wrong, message in (
        ({"schema_version": 2}, "expected 'og-image-encoder' 1"), ({"width": -1}, "is -1"), ({"crops": []}, "crops"),
        ({"crops": [{"scale": 0.5}]}, "scale 1 to 8"), ({"preprocessing": {"size": 1e9}}, "mean"),
        ({"files": {}}, "image_encoder.onnx"),
    ):  # fmt: skip
        with pytest.raises(OgPointcloudError, match=message):
            OnnxModel(exported(tmp_path / "e", **wrong))
    model = OnnxModel(exported(tmp_path / "e", width=65))
    with pytest.raises(OgPointcloudError, match="returns float32"):
        model(np.zeros((1, 3, 48, 48), np.float32))
    with pytest.raises(OgPointcloudError, match="does not run"):
        OnnxModel(DEMO_ENCODER / "image")(np.zeros((1, 4, 48, 48), np.float32))
