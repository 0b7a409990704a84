"""Dense features: patches against a literal run of the model's parts, and masks' means against slow loops."""

from __future__ import annotations

import numpy as np
import pytest
from test_masks_command import make_capture
from text_models import OUT, PATCH, SIZE, SPACE, write_model

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.masking.contracts import MaskSettings
from og_pointcloud.masking.encode import open_encoder
from og_pointcloud.masking.make_masks import make_masks

torch = pytest.importorskip("torch")
pytest.importorskip("transformers")

from og_pointcloud.masking.clip import ImageTower, TransformersModel, load_model  # noqa: E402
from og_pointcloud.masking.dense import DenseEncoder  # noqa: E402

KINDS = ("clip", "siglip")


@pytest.fixture(scope="module", params=KINDS)
def folder(request, tmp_path_factory):
    return write_model(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def encoder(folder):
    return DenseEncoder(TransformersModel(folder, SPACE))


def pixels(height, width, seed=0):
    return torch.randn(1, 3, height, width, generator=torch.Generator().manual_seed(seed))


def literal_patches(model, image):
    """Layer by layer, token by token, float64."""
    model = model.double()
    vision = model.vision_model
    tokens = vision.embeddings(image.double(), interpolate_pos_encoding=True)
    is_clip = model.config.model_type == "clip"
    layers = list(vision.encoder.layers)
    if is_clip:
        tokens = vision.pre_layrnorm(tokens)
    for layer in layers[:-1] if is_clip else layers:
        tokens = layer(tokens, attention_mask=None)
    vectors = []
    for token in tokens[0, 1:] if is_clip else tokens[0]:
        if is_clip:  # a sequence of one token attends to nothing else
            alone = layers[-1](token[None, None], attention_mask=None)[0, 0]
            found = model.visual_projection(vision.post_layernorm(alone))
        else:
            found = vision.head(vision.post_layernorm(token)[None, None])[0]
        vectors.append((found / found.norm()).detach().numpy())
    model.float()
    return np.array(vectors)


@pytest.mark.parametrize("shape", [(2, 3), (4, 4), (5, 2)])
def test_patches_are_the_models_own_tokens_alone(folder, shape):
    model = load_model(folder, "eager")
    image = pixels(shape[0] * PATCH, shape[1] * PATCH)
    with torch.inference_mode():
        (found,) = ImageTower(model)(image)[1].numpy()
    assert found.shape == (*shape, OUT if model.config.model_type == "clip" else 32)
    np.testing.assert_allclose(found.reshape(-1, found.shape[-1]), literal_patches(model, image), atol=2e-5)


def test_an_image_of_one_siglip_patch_is_that_patch(tmp_path):
    """The head of a SigLIP sees a whole image of one patch as the patch alone: both ways are one."""
    model = load_model(write_model(tmp_path, "siglip"))
    with torch.inference_mode():
        image = pixels(PATCH, PATCH)
        whole = model.get_image_features(pixel_values=image, interpolate_pos_encoding=True).pooler_output
        image_vector, patches = ImageTower(model)(image)
        np.testing.assert_allclose(patches[0, 0, 0], (whole / whole.norm())[0], atol=1e-5)
        np.testing.assert_allclose(image_vector, patches[0, 0], atol=1e-5)


def test_a_masks_vector_is_the_mean_of_its_patches_by_what_it_covers(encoder):
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (96, 144, 3)).astype(np.uint8)
    masks = random.uniform(size=(3, 96, 144)) < np.array([0.3, 0.02, 1.1])[:, None, None]
    grid = encoder.model.patches(encoder._pixels(image))
    height, width, _ = grid.shape
    assert (height, width) == (2 * SIZE // PATCH, 3 * SIZE // PATCH)
    down, across = 96 // height, 144 // width
    for mask, vector in zip(masks, encoder.embed(image, masks), strict=True):
        total = np.zeros(grid.shape[2])
        for row in range(height):
            for column in range(width):
                share = mask[row * down : (row + 1) * down, column * across : (column + 1) * across].mean()
                total += share * grid[row, column].astype(np.float64)
        np.testing.assert_allclose(vector, total / np.linalg.norm(total), atol=1e-5)


def test_the_smallest_mask_and_none_at_all(encoder):
    image = np.full((40, 33, 3), 90, np.uint8)  # smaller than the model's square, and of no whole patches
    masks = np.zeros((2, 40, 33), bool)
    masks[0, 39, 32] = masks[1] = True
    vectors = encoder.embed(image, masks)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    assert encoder.embed(image, masks[:0]).shape == (0, encoder.width)
    with pytest.raises(SceneError, match="no pixel"):
        encoder.embed(image, np.zeros((1, 40, 33), bool))
    with pytest.raises(SceneError, match="the size of the image"):
        encoder.embed(image, masks[:, :20])


def test_a_model_without_patches_is_refused(tmp_path):
    make_capture(tmp_path / "c", 1)
    with pytest.raises(OgPointcloudError, match=r"encoder 'demo' only has vectors of whole crops; .*crops"):
        make_masks(tmp_path / "c", MaskSettings(features="dense"), progress=False)
    with pytest.raises(OgPointcloudError, match="features are 'thick'; expected one of crops, dense"):
        MaskSettings(features="thick")
    with pytest.raises(OgPointcloudError, match="features are 'dense' without an encoder"):
        MaskSettings(features="dense", encoder=None)
    assert open_encoder("demo").width
