"""SAM's encoder and decoder as ONNX models made on the spot."""

from __future__ import annotations

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.worker import open_proposer

FLOAT = TensorProto.FLOAT


def save(path, nodes, inputs, outputs, constants=()):
    initializers = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants]
    graph = helper.make_graph(
        nodes, "g",
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in inputs],
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in outputs],
        initializers,
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def bright_square():
    """A dark image, 40 rows and 60 columns, with a light rectangle."""
    image = np.zeros((40, 60, 3), np.uint8)
    image[10:30, 20:50] = 255
    return image, image[:, :, 0] > 0


# SAM ------------------------------------------------------------------------------------------------------------


def sam_pair(folder):
    """Encoder: the mean of the channels, unscaled, at a quarter. Decoder: three masks, the light parts, the dark ones
    and all, if the point's x is not negative; IoU 0.9, 0.95 and 0.1."""
    side = 64
    weight = np.full((1, 3, 4, 4), 1 / 48, np.float32)
    encoder = save(
        folder / "encoder.onnx",
        [helper.make_node("Conv", ["image", "w"], ["embedding"], strides=[4, 4])],
        [("image", [1, 3, side, side])], [("embedding", [1, 1, 16, 16])], [("w", weight)],
    )  # fmt: skip
    used = ["point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"]
    nodes = [
        helper.make_node("Mul", ["image_embeddings", "ten"], ["light"]),
        helper.make_node("Neg", ["light"], ["dark"]),
        helper.make_node("Concat", ["light", "dark", "light"], ["low_res_masks"], axis=1),
        *[helper.make_node("ReduceSum", [name], [f"{name}_sum"], keepdims=0) for name in used],
        helper.make_node("Sum", [f"{name}_sum" for name in used], ["total"]),
        helper.make_node("Mul", ["total", "zero"], ["nothing"]),
        helper.make_node("Add", ["iou", "nothing"], ["iou_predictions"]),
    ]
    decoder = save(
        folder / "decoder.onnx", nodes,
        [
            ("image_embeddings", [1, 1, 16, 16]), ("point_coords", [1, "n", 2]), ("point_labels", [1, "n"]),
            ("mask_input", [1, 1, 256, 256]), ("has_mask_input", [1]), ("orig_im_size", [2]),
        ],
        [("iou_predictions", [1, 3]), ("low_res_masks", [1, 3, 16, 16])],
        [("ten", np.float32(10)), ("zero", np.float32(0)), ("iou", np.array([[0.9, 0.95, 0.1]], np.float32))],
    )  # fmt: skip
    return encoder, decoder


def test_sam_pair_answers_on_the_images_own_pixels(tmp_path):
    encoder, decoder = sam_pair(tmp_path)
    proposer = open_proposer(f"onnx:{encoder},{decoder}")
    image, light = bright_square()
    proposer.predictor.set_image(image)
    logits, iou = proposer.predictor.at_points(np.array([[30, 20], [1, 1]], np.float32))
    assert logits.shape == (2, 3, 11, 16)  # 43 of 64 rows are image
    assert iou.shape == (2, 3)
    proposals = proposer.propose(image)
    assert proposals.scores.tolist() == pytest.approx([0.95, 0.9])
    overlap = (proposals.masks[1] & light).sum() / (proposals.masks[1] | light).sum()
    assert overlap > 0.7
    assert not (proposals.masks[0] & light)[14:26, 26:44].any()


def test_sam_preparation_is_the_torch_ones(tmp_path):
    """The encoder sees what the SAM processor makes of an image that needs no scaling."""
    encoder, decoder = sam_pair(tmp_path)
    predictor = open_proposer(f"onnx:{encoder},{decoder}").predictor
    image = np.random.default_rng(0).integers(0, 256, (32, 64, 3)).astype(np.uint8)
    predictor.set_image(image)
    pixels = (image / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    expected = np.zeros((16, 16))
    expected[:8] = pixels.mean(axis=2).reshape(8, 4, 16, 4).mean(axis=(1, 3))
    assert np.allclose(predictor.embedding[0, 0], expected, atol=1e-5)


def test_a_decoder_of_another_kind_is_refused(tmp_path):
    encoder, _ = sam_pair(tmp_path)
    with pytest.raises(SceneError, match="export it with segment-anything"):
        open_proposer(f"onnx:{encoder},{encoder}")


def test_files_that_are_no_pair_of_models(tmp_path):
    encoder, _ = sam_pair(tmp_path)
    with pytest.raises(SceneError, match=r"none.onnx is no file"):
        open_proposer(f"onnx:{encoder},{tmp_path / 'none.onnx'}")
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with pytest.raises(SceneError, match="cannot be opened"):
        open_proposer(f"onnx:{tmp_path / 'junk.onnx'},{encoder}")
    for files in ("a", "a,b,c"):
        with pytest.raises(SceneError, match=r"expected two, SAM's encoder and decoder: .* COCO"):
            open_proposer(f"onnx:{files}")
