"""Image towers against transformers and a plain forward pass, their exports, and the opening of encoders."""

from __future__ import annotations

import json
import logging
import shutil

import numpy as np
import pytest
from image_models import (
    OUT,
    SIZE,
    SPACE,
    WIDTH,
    forward_plainly,
    open_clip_state,
    transformers_model,
    transformers_vectors,
    write_open_clip,
)

from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, SceneError
from og_pointcloud.masking.crops import LANGSPLAT, WITH_CONTEXT, Crop, mask_crops
from og_pointcloud.masking.encoders import CropEncoder, PatchEncoder, open_encoder
from og_pointcloud.masking.encoders.onnx_model import OnnxModel
from og_pointcloud.masking.encoders.preprocessing import CLIP_MEAN, CLIP_STD, HALF, Preprocessing

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from og_pointcloud_export.image_encoder import TorchModel, export_image_encoder, open_tower  # noqa: E402
from og_pointcloud_export.image_weights import read_image_tower  # noqa: E402

RNG = np.random.default_rng(0)
PIXELS = RNG.normal(size=(3, 3, SIZE, SIZE)).astype(np.float32)
IMAGE = RNG.integers(0, 256, (40, 60, 3), np.uint8)
MASKS = np.zeros((3, 40, 60), bool)
MASKS[0, 5:20, 10:40], MASKS[1, 30:, 50:], MASKS[2] = True, True, True


@pytest.fixture(autouse=True)
def _quiet():
    torch.set_num_threads(1)
    logging.getLogger("transformers").setLevel(logging.ERROR)


@pytest.fixture
def clip_folder(tmp_path):
    return write_open_clip(tmp_path / "open_clip")


@pytest.fixture
def exported(clip_folder, tmp_path):
    return export_image_encoder(clip_folder, tmp_path / "exported", feature_space=SPACE)[0]


# Towers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["clip", "siglip", "siglip2"])
def test_a_transformers_model_gives_the_vectors_that_transformers_gives(family, tmp_path):
    pytest.importorskip("transformers")
    model = transformers_model(family)
    model.save_pretrained(tmp_path / "model")
    tower = open_tower(tmp_path / "model", SPACE)
    expected = transformers_vectors(model, PIXELS)
    assert np.abs(tower(PIXELS) - expected).max() < 1e-5
    folder, manifest = export_image_encoder(tmp_path / "model", tmp_path / "out", feature_space=SPACE)
    assert np.abs(OnnxModel(folder)(PIXELS) - expected).max() < 1e-5
    assert manifest["parity"]["max_abs_error"] < 1e-5
    assert manifest["width"] == tower.width == (OUT if family == "clip" else WIDTH)
    assert (np.abs(expected[0] - expected[1]) > 1e-3).any(), "the tower looks at its pixels"


@pytest.mark.parametrize("quick_gelu", [False, True])
def test_an_open_clip_model_gives_the_vectors_of_a_plain_forward_pass(quick_gelu, tmp_path):
    folder = write_open_clip(tmp_path / "model", quick_gelu=quick_gelu)
    expected = [
        forward_plainly(open_clip_state(), image, activation="quick_gelu" if quick_gelu else "gelu") for image in PIXELS
    ]
    tower = open_tower(folder, SPACE)
    assert np.abs(tower(PIXELS) - expected).max() < 1e-5
    out, _ = export_image_encoder(folder, tmp_path / "out", feature_space=SPACE)
    assert np.abs(OnnxModel(out)(PIXELS) - expected).max() < 1e-5
    assert tower.preprocessing.mean == HALF
    assert tower.preprocessing.std == (0.25, 0.25, 0.25)


def test_a_file_of_weights_needs_its_activation(tmp_path):
    torch.save(open_clip_state(), tmp_path / "weights.pt")
    with pytest.raises(OgPointcloudError, match="--activation"):
        open_tower(tmp_path / "weights.pt", SPACE)
    tower = open_tower(tmp_path / "weights.pt", SPACE, "gelu").tower
    assert tower.heads == 1, "heads of 64, as all such files have them"
    assert (tower.preprocessing.mean, tower.preprocessing.std) == (CLIP_MEAN, CLIP_STD)


def test_code_in_a_file_of_weights_does_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    torch.save({"visual.proj": Bomb()}, tmp_path / "weights.pt")
    with pytest.raises(OgPointcloudError, match="weights only"):
        open_tower(tmp_path / "weights.pt", SPACE, "gelu")
    assert not (tmp_path / "ran").exists()


def test_what_is_not_understood_is_refused_by_name(tmp_path):
    with pytest.raises(OgPointcloudError, match="attentional_pool"):
        open_tower(write_open_clip(tmp_path / "model", attentional_pool=True), SPACE)
    with pytest.raises(OgPointcloudError, match="--feature-space"):
        open_tower(write_open_clip(tmp_path / "other"))
    state = open_clip_state()
    state["visual.positional_embedding"] = state["visual.positional_embedding"][:-1]
    torch.save(state, tmp_path / "weights.pt")
    with pytest.raises(OgPointcloudError, match="15 patches"):
        open_tower(tmp_path / "weights.pt", SPACE, "gelu")


def test_a_patch_alone_is_what_its_own_values_say(clip_folder):
    """The last block's attention mixes nothing: patches change only where the pixels before that block reach them."""
    model = TorchModel(read_image_tower(clip_folder), SPACE)
    patches = model.patches(PIXELS)
    assert patches.shape == (3, SIZE // 8, SIZE // 8, OUT)
    assert np.allclose(np.linalg.norm(patches, axis=3), 1, atol=1e-5)
    one_block = TorchModel(_shortened(model.tower), SPACE)
    changed = PIXELS.copy()
    changed[:, :, :8, 8:16] += 1
    moved = np.abs(one_block.patches(changed) - one_block.patches(PIXELS)).max(axis=3) > 1e-6
    assert moved[:, 0, 1].all()
    assert moved.sum() == 3, "of one block, a patch sees itself alone"


def _shortened(tower):
    from dataclasses import replace

    return replace(tower, blocks=tower.blocks[:1])


@pytest.mark.parametrize("family", ["siglip", "clip"])
def test_a_patch_of_an_even_image_without_places_says_what_the_image_says(family, tmp_path):
    """All patches equal: attention over all is attention to oneself, so that pooling must be the same pooling."""
    pytest.importorskip("transformers")
    from dataclasses import replace

    model = transformers_model(family)
    model.save_pretrained(tmp_path)
    tower = read_image_tower(tmp_path)
    tower = replace(tower, position_embedding=np.zeros_like(tower.position_embedding))
    if tower.class_token is not None:
        tower = replace(tower, blocks=tower.blocks[:0] + tower.blocks[:1])
    even = TorchModel(tower, SPACE)
    pixels = np.broadcast_to(np.float32([0.3, -1, 0.5])[None, :, None, None], (1, 3, SIZE, SIZE)).copy()
    patches = even.patches(pixels)[0].reshape(-1, even.width)
    assert np.abs(patches - patches[0]).max() < 1e-5
    if family == "siglip":
        assert np.abs(patches[0] - even(pixels)[0]).max() < 1e-5


# Preprocessing --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(480, 640), (37, 91), (224, 224), (700, 300)])
@pytest.mark.parametrize("family", ["clip", "siglip"])
def test_preprocessing_is_that_of_the_models_own_processor(family, shape):
    transformers = pytest.importorskip("transformers")
    image = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    image[: shape[0] // 2] = image[: shape[0] // 2, :1]  # edges and flat parts, not noise alone
    if family == "clip":
        processor, ours = transformers.CLIPImageProcessor(), Preprocessing(224, CLIP_MEAN, CLIP_STD)
    else:
        processor = transformers.SiglipImageProcessor(size={"height": 224, "width": 224}, resample=3)
        ours = Preprocessing(224, HALF, HALF, keeps_shape=False)
    expected = np.asarray(processor(image, return_tensors="np", input_data_format="channels_last")["pixel_values"])
    levels = np.abs(ours.pixels(ours.square(image)[None]) - expected) * 255 * np.array(ours.std)[:, None, None]
    assert levels.max() < 1.01, "one level of 255 at most"
    assert (levels > 0.5).mean() < 0.005


# Mask encoders --------------------------------------------------------------------------------------------------


class MeanColour:
    """An image model that says a square's mean colour."""

    feature_space, width, preprocessing = SPACE, 3, Preprocessing(8, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def __init__(self):
        self.runs = []

    def __call__(self, pixels):
        self.runs.append(len(pixels))
        means = pixels.mean(axis=(2, 3)) + 1e-6
        return means / np.linalg.norm(means, axis=1, keepdims=True)


def test_a_masks_vector_is_the_weighted_mean_of_its_crops():
    model = MeanColour()
    crops = (Crop(1.0, 0.0, 1.0), Crop(2.0, 0.5, 0.25))
    got = CropEncoder(model, crops, crops_per_run=2).embed(IMAGE, MASKS)
    assert model.runs == [2, 1, 2, 1]
    expected = np.zeros((3, 3))
    for row, mask in enumerate(MASKS):
        for crop in crops:
            square = mask_crops(IMAGE, mask[None], crop, 8, (0, 0, 0))
            expected[row] += crop.weight * model(model.preprocessing.pixels(square))[0]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.abs(got - expected).max() < 1e-6
    assert got.dtype == np.float32


def test_the_time_of_an_image_is_kept_by_leaving_crops_out(monkeypatch):
    from og_pointcloud.masking.encoders import mask_encoder

    clock = iter(range(100))  # every look at the clock is a second later
    monkeypatch.setattr(mask_encoder.time, "perf_counter", lambda: float(next(clock)))
    model = MeanColour()
    CropEncoder(model, WITH_CONTEXT, seconds_per_image=2.5).embed(IMAGE, MASKS)
    assert model.runs == [3], "after the first way, 2 s by its pace, the second would end at 4 s"
    CropEncoder(model, WITH_CONTEXT, seconds_per_image=100).embed(IMAGE, MASKS)
    assert model.runs == [3] * 4


def test_no_mask_is_no_row_and_an_empty_mask_an_error(clip_folder):
    for encoder in (open_encoder(clip_folder, SPACE), open_encoder(clip_folder, SPACE, dense=True)):
        assert encoder.embed(IMAGE, MASKS[:0]).shape == (0, OUT)
        with pytest.raises(SceneError, match=r"empty|no pixel"):
            encoder.embed(IMAGE, np.zeros((1, 40, 60), bool))
        with pytest.raises(SceneError, match=r"size|as large"):
            encoder.embed(IMAGE, np.ones((1, 30, 60), bool))


class GridColour(MeanColour):
    """Each patch says its own mean colour."""

    grid = 4

    def patches(self, pixels):
        cells = pixels.reshape(len(pixels), 3, 4, 2, 4, 2).mean(axis=(3, 5)).transpose(0, 2, 3, 1) + 1e-6
        return cells / np.linalg.norm(cells, axis=3, keepdims=True)


@pytest.mark.parametrize("turned", [False, True])
def test_patches_are_pooled_where_the_mask_is(turned):
    """Left third red, middle green, right blue, in 12 x 24 pixels: two squares, each seen on its own."""
    image = np.zeros((12, 24, 3), np.uint8)
    image[:, :6, 0] = image[:, 6:18, 1] = image[:, 18:, 2] = 255
    masks = np.zeros((3, 12, 24), bool)
    masks[0, :, :6], masks[1, 4:9, 20:23], masks[2, :, 9:15] = True, True, True
    if turned:
        image, masks = image.transpose(1, 0, 2), masks.transpose(0, 2, 1)
    vectors = PatchEncoder(GridColour()).embed(image, masks)
    assert vectors.argmax(axis=1).tolist() == [0, 2, 1]
    assert vectors.max(axis=1).min() > 0.9


# Opening --------------------------------------------------------------------------------------------------------


def test_weights_their_export_and_its_name_give_the_same(clip_folder, exported, tmp_path, monkeypatch):
    from_weights = open_encoder(clip_folder, SPACE).embed(IMAGE, MASKS)
    assert np.abs(open_encoder(exported).embed(IMAGE, MASKS) - from_weights).max() < 1e-5
    with pytest.raises(OgPointcloudError, match="hf download tests/tiny-vit"):
        open_encoder(SPACE)
    monkeypatch.setenv("OG_POINTCLOUD_MODELS", str(tmp_path))
    found = open_encoder(SPACE)
    assert (found.feature_space, found.width) == (SPACE, OUT)
    assert np.abs(found.embed(IMAGE, MASKS) - from_weights).max() < 1e-5


def test_another_space_than_the_words_is_refused(exported):
    with pytest.raises(FeatureSpaceError, match=r"tests/tiny-vit.*openai/clip-vit-base-patch16"):
        open_encoder(exported, "openai/clip-vit-base-patch16")


def test_crops_are_the_callers_then_the_exports(clip_folder, exported, tmp_path):
    assert open_encoder(exported).crops == WITH_CONTEXT
    assert open_encoder(exported, crops="langsplat").crops == LANGSPLAT
    out, _ = export_image_encoder(clip_folder, tmp_path / "other", feature_space=SPACE, crops=LANGSPLAT)
    assert open_encoder(out).crops == LANGSPLAT
    with pytest.raises(OgPointcloudError, match="langsplat or context"):
        open_encoder(exported, crops="square")
    with pytest.raises(OgPointcloudError, match="own folder"):
        open_encoder(exported, dense=True)


def test_an_exported_folder_is_checked_before_it_runs(exported, tmp_path):
    def changed(name, edit):
        folder = tmp_path / "changed"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(exported, folder)
        (folder / name).write_bytes(edit((folder / name).read_bytes()))
        return folder

    def field(**fields):
        return lambda data: json.dumps({**json.loads(data), **fields}).encode()

    with pytest.raises(OgPointcloudError, match="checksum"):
        OnnxModel(changed("image_encoder.onnx", lambda data: data[:-1] + b"x"))
    for wrong, message in (
        ({"schema_version": 2}, "expected 'og-image-encoder' 1"), ({"width": -1}, "width -1"), ({"crops": []}, "crops"),
        ({"crops": [{"scale": 0.5}]}, "scale 1 to 16"), ({"preprocessing": {"size": 1e9}}, "mean"),
        ({"files": {}}, "image_encoder.onnx"),
    ):  # fmt: skip
        with pytest.raises(OgPointcloudError, match=message):
            OnnxModel(changed("manifest.json", field(**wrong)))
    with pytest.raises(OgPointcloudError, match="gives float32"):
        OnnxModel(changed("manifest.json", field(width=OUT + 1)))(PIXELS)


def test_an_export_that_fails_writes_nothing(clip_folder, tmp_path, monkeypatch):
    from og_pointcloud_export import image_encoder

    monkeypatch.setattr(image_encoder, "TOLERANCE", 0.0)
    with pytest.raises(OgPointcloudError, match="differs from torch"):
        export_image_encoder(clip_folder, tmp_path / "out", feature_space=SPACE)
    assert not (tmp_path / "out").exists()


def test_the_command_writes_what_masks_open(clip_folder, tmp_path, capsys):
    from og_pointcloud.cli import main

    out = tmp_path / "out"
    command = [
        "export-image-encoder",
        str(clip_folder),
        "-o",
        str(out),
        "--feature-space",
        SPACE,
        "--crops",
        "langsplat",
    ]
    assert main(command) == 0
    assert "differ by" in capsys.readouterr().out
    assert open_encoder(out, SPACE).crops == LANGSPLAT
    assert main(["export-image-encoder", str(tmp_path / "none")]) == 2
