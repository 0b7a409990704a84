"""SAM, SAM-HQ, SAM 2 and SAM 3: tiny models with random weights in transformers' own formats, made on the spot."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.worker import open_proposer

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

from safetensors.torch import load_file, save_file  # noqa: E402

from og_pointcloud.masking.automatic import AutomaticMasks  # noqa: E402
from og_pointcloud.masking.sam import IMAGENET_MEAN_STD, Preparation, SamPredictor, prepared, scaled_size  # noqa: E402

KINDS = ("sam", "sam_hq", "sam2", "sam3")
PROMPT = {"hidden_size": 32, "mask_input_channels": 4}
DECODER = {
    "hidden_size": 32,
    "mlp_dim": 32,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "iou_head_hidden_dim": 32,
}


def tiny_sam(kind: str):
    """A model of a few thousand weights that takes 64x64 pixels, SAM 3's 56x56."""
    torch.manual_seed(0)
    name = {"sam": "Sam", "sam_hq": "SamHQ", "sam2": "Sam2", "sam3": "Sam3Tracker"}[kind]
    prompt, decoder = {**PROMPT, "image_size": 64, "patch_size": 16}, DECODER
    if kind in ("sam", "sam_hq"):
        vision = {
            "hidden_size": 24, "output_channels": 32, "num_hidden_layers": 2, "num_attention_heads": 2,
            "image_size": 64, "patch_size": 16, "window_size": 2, "global_attn_indexes": [1], "mlp_dim": 32,
            "num_pos_feats": 16,
        }  # fmt: skip
        prompt["image_embedding_size"] = 4
        decoder = {**DECODER, "vit_dim": 24} if kind == "sam_hq" else DECODER
    elif kind == "sam2":
        backbone = {
            "hidden_size": 8, "image_size": [64, 64],
            "blocks_per_stage": [1, 1, 2, 1], "window_size_per_stage": [8] * 4,
            "embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 1, 2, 2],
            "global_attention_blocks": [3], "window_positional_embedding_background_size": [4, 4],
        }  # fmt: skip
        vision = {
            "backbone_config": {"model_type": "sam2_hiera_det_model", **backbone},
            "backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 32,
        }  # fmt: skip
    else:
        backbone = {
            "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2,
            "num_attention_heads": 2, "image_size": 56, "patch_size": 14, "window_size": 2,
            "global_attn_indexes": [1], "pretrain_image_size": 56,
        }  # fmt: skip
        vision = {
            "model_type": "sam3_vision_model", "backbone_config": backbone, "fpn_hidden_size": 32,
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        }  # fmt: skip
        prompt = {**PROMPT, "image_size": 56, "patch_size": 14}
    configs = {"vision_config": vision, "prompt_encoder_config": prompt, "mask_decoder_config": decoder}
    return getattr(transformers, f"{name}Model")(getattr(transformers, f"{name}Config")(**configs))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {}
    for kind in KINDS:
        made[kind] = tmp_path_factory.mktemp(kind)
        tiny_sam(kind).save_pretrained(made[kind])
    return made


@pytest.fixture(scope="module")
def image():
    return np.random.default_rng(0).integers(0, 256, (36, 60, 3)).astype(np.uint8)


@pytest.mark.parametrize("kind", KINDS)
def test_loads_and_answers_as_the_model_itself(folders, image, kind):
    predictor = SamPredictor(folders[kind])
    predictor.set_image(image)
    points = np.array([[10, 20], [50, 5], [0, 0]], np.float32)
    logits, iou = predictor.at_points(points)
    assert logits.shape[:2] == iou.shape == (3, 3)
    reloaded = predictor.loaded.model
    height, width = scaled_size((36, 60), predictor.loaded.preparation)
    scaled = torch.tensor(points * np.array([width / 60, height / 36], np.float32))[None, :, None]
    with torch.inference_mode():
        said = reloaded(pixel_values=prepared(image, predictor.loaded.preparation), input_points=scaled)
    rows, columns = logits.shape[2:]
    assert np.allclose(logits, said.pred_masks[0, :, :, :rows, :columns].numpy(), atol=1e-4)
    assert np.allclose(iou, said.iou_scores[0].numpy(), atol=1e-5)
    padded = predictor.loaded.preparation.padded
    assert (rows, columns) == ((10, 16) if padded else (16, 16))


@pytest.mark.parametrize("shape", [(36, 60), (90, 33), (64, 64), (5, 200)])
def test_preparation_is_what_transformers_own_sam_processor_does(folders, shape):
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    own = SamImageProcessorPil(size={"longest_edge": 64}, pad_size={"height": 64, "width": 64})
    image = np.random.default_rng(1).integers(0, 256, (*shape, 3)).astype(np.uint8)
    expected = own(image, return_tensors="np")["pixel_values"]
    ours = prepared(image, SamPredictor(folders["sam"]).loaded.preparation).numpy()
    one_step = 1 / 255 / 0.224
    assert ours.shape == expected.shape
    assert np.abs(ours - expected).max() < 1.01 * one_step
    assert np.abs(ours - expected).mean() < 0.15 * one_step  # Pillow rounds between its two passes


@pytest.mark.parametrize("kind", ["sam2", "sam3"])
def test_squares_are_resized_as_pillow_does_and_colors_come_from_the_models_file(folders, image, kind):
    from PIL import Image

    said = folders[kind] / "preprocessor_config.json"
    said.write_text(json.dumps({"image_mean": [0.1, 0.2, 0.3], "image_std": [0.5, 0.6, 0.7]}))
    preparation = SamPredictor(folders[kind]).loaded.preparation
    said.unlink()
    side = preparation.side
    resized = np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BILINEAR), np.float32) / 255
    expected = ((resized - [0.1, 0.2, 0.3]) / [0.5, 0.6, 0.7]).transpose(2, 0, 1)
    assert side == {"sam2": 64, "sam3": 56}[kind]
    assert np.abs(prepared(image, preparation)[0].numpy() - expected).max() < 1.01 / 255 / 0.5


def test_a_strip_of_an_image_keeps_a_pixel_of_its_shorter_side():
    wide = Preparation(1024, True, *IMAGENET_MEAN_STD)
    assert scaled_size((1, 2400), wide) == (1, 1024)
    assert scaled_size((2400, 1), wide) == (1024, 1)
    assert prepared(np.zeros((1, 2400, 3), np.uint8), wide).shape == (1, 3, 1024, 1024)


def test_colors_without_a_file_are_the_familys(folders):
    assert SamPredictor(folders["sam2"]).loaded.preparation.mean[0] == 0.485
    assert SamPredictor(folders["sam3"]).loaded.preparation.mean[0] == 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_proposes_masks_of_the_images_size(folders, image, kind):
    proposer = AutomaticMasks(SamPredictor(folders[kind]), points_per_side=4, batch=5, least_iou=-9, least_stability=0)
    proposals = proposer.propose(image)
    assert proposals.masks.shape[1:] == (36, 60)
    assert len(proposals) > 0
    assert (np.diff(proposals.scores) <= 0).all()


def test_a_folder_of_another_model_is_refused(tmp_path):
    transformers.BertConfig().save_pretrained(tmp_path)
    with pytest.raises(SceneError, match="model_type is 'bert'; expected one of sam"):
        open_proposer(f"sam:{tmp_path}")


def test_nothing_is_downloaded_unasked(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    with pytest.raises(SceneError, match="no SAM model 'nobody/nothing'"):
        open_proposer("sam:nobody/nothing")


@pytest.mark.parametrize("kind", ["sam", "their_own"])
def test_no_code_of_a_models_folder_runs(folders, image, tmp_path, kind):
    """Neither for a known model_type nor for one that only the folder's code knows."""
    shutil.copytree(folders["sam"], tmp_path / "model")
    ran = tmp_path / "ran"
    (tmp_path / "model" / "theirs.py").write_text(f"open({str(ran)!r}, 'w')\nclass Config: pass\nclass Model: pass\n")
    file = tmp_path / "model" / "config.json"
    config = json.loads(file.read_text())
    code = {"AutoConfig": "theirs.Config", "AutoModel": "theirs.Model", "SamModel": "theirs.Model"}
    file.write_text(json.dumps({**config, "model_type": kind, "auto_map": code}))
    if kind == "sam":
        SamPredictor(tmp_path / "model").set_image(image)
    else:
        with pytest.raises(SceneError, match="model_type is 'their_own'; expected one of sam"):
            SamPredictor(tmp_path / "model")
    assert not ran.exists()


@pytest.mark.parametrize("place", ["attn_implementation", "_attn_implementation"])
def test_a_folder_does_not_say_how_attention_is_computed(folders, tmp_path, place):
    """transformers would fetch what such a name means."""
    shutil.copytree(folders["sam"], tmp_path / "model")
    file = tmp_path / "model" / "config.json"
    config = json.loads(file.read_text())
    vision = {**config["vision_config"], place: "stranger/kernels"}
    file.write_text(json.dumps({**config, place: "stranger/kernels", "vision_config": vision}))
    model = SamPredictor(tmp_path / "model").loaded.model
    assert model.config._attn_implementation == model.vision_encoder.config._attn_implementation == "sdpa"


@pytest.mark.parametrize(
    ("change", "says"),
    [("pickle", "weights in .safetensors"), ("quantized", "is quantized"), ("missing", "lacks 1 of the weights")],
)
def test_weights_are_plain_numbers_and_all_there(folders, tmp_path, change, says):
    folder = tmp_path / "model"
    shutil.copytree(folders["sam"], folder)
    if change == "pickle":
        (folder / "model.safetensors").unlink()
        torch.save({"weight": torch.zeros(1)}, folder / "pytorch_model.bin")
    elif change == "missing":  # transformers would draw them at random
        weights = load_file(folder / "model.safetensors")
        weights.pop("mask_decoder.mask_tokens.weight")
        save_file(weights, folder / "model.safetensors", {"format": "pt"})
    else:
        config = json.loads((folder / "config.json").read_text())
        config["quantization_config"] = {"quant_method": "bitsandbytes", "load_in_8bit": True}
        (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(SceneError, match=says):
        SamPredictor(folder)


@pytest.mark.parametrize("content", ["[]", "{", "", '{"model_type": ["sam"]}'])
def test_a_folder_with_another_config_is_one_error(tmp_path, content):
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(SceneError, match=r"expected|not valid JSON"):
        SamPredictor(tmp_path)
    (tmp_path / "config.json").unlink()
    with pytest.raises(SceneError, match=r"has no config.json"):
        SamPredictor(tmp_path)
