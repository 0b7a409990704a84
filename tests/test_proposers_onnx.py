"""ONNX models made on the spot: SAM's encoder and decoder, YOLO's layout, and plain boxes, scores and masks."""

from __future__ import annotations

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.masking.opening import open_proposer

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


def constant_outputs(path, inputs, outputs):
    """A graph that gives the same arrays whatever it is shown."""
    nodes = [helper.make_node("Identity", [f"{name}_value"], [name]) for name in outputs]
    return save(
        path, nodes, inputs, [(name, list(value.shape)) for name, value in outputs.items()],
        [(f"{name}_value", np.asarray(value, np.float32)) for name, value in outputs.items()],
    )  # fmt: skip


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


# Detectors ------------------------------------------------------------------------------------------------------


def yolo(path, side=64):
    """Two detections of one thing, one of another class elsewhere, one below the threshold; two prototypes."""
    x = np.zeros((1, 4 + 3 + 2, 5), np.float32)
    x[0, :4, 0], x[0, 4, 0], x[0, 7:, 0] = (32, 32, 40, 20), 0.9, (1, 0)
    x[0, :4, 1], x[0, 4, 1], x[0, 7:, 1] = (33, 32, 40, 20), 0.8, (1, 0)
    x[0, :4, 2], x[0, 6, 2], x[0, 7:, 2] = (8, 16, 8, 8), 0.7, (0, 1)
    x[0, :4, 3], x[0, 5, 3], x[0, 7:, 3] = (50, 50, 8, 8), 0.1, (1, 1)
    prototypes = np.full((1, 2, side // 4, side // 4), 9, np.float32)
    prototypes[0, 0, :, 12:] = -9  # the first thing ends at x = 48
    return constant_outputs(path, [("images", [1, 3, side, side])], {"output0": x, "output1": prototypes})


def test_yolo_layout(tmp_path):
    proposer = open_proposer(f"onnx:{yolo(tmp_path / 'yolo.onnx')}")
    proposals = proposer.propose(np.zeros((32, 64, 3), np.uint8))  # 16 rows of grey above and below
    assert proposals.scores.tolist() == pytest.approx([0.9, 0.7])
    first, second = proposals.masks
    assert first[6:26, 12:47].all()
    assert not first[:6].any()
    assert not first[26:].any()
    assert not first[:, :12].any()
    assert not first[:, 49:].any()
    assert np.argwhere(second).min(axis=0).tolist() == [0, 4]
    assert np.argwhere(second).max(axis=0).tolist() == [3, 11]


def test_yolo_without_detections(tmp_path):
    outputs = {"output0": np.zeros((1, 9, 5)), "output1": np.zeros((1, 2, 16, 16))}
    path = constant_outputs(tmp_path / "yolo.onnx", [("images", [1, 3, 64, 64])], outputs)
    assert len(open_proposer(f"onnx:{path}").propose(np.zeros((30, 20, 3), np.uint8))) == 0


@pytest.mark.parametrize("batched", [True, False])
def test_plain_layout(tmp_path, batched):
    masks = np.zeros((3, 1, 32, 48), np.float32)
    masks[0, 0, 4:20, 8:24], masks[1, 0, 4:20, 8:24], masks[2, 0, 20:30, 30:40] = 0.9, 0.9, 0.4
    outputs = {
        "boxes": np.array([[8, 4, 24, 20], [8, 4, 24, 21], [30, 20, 40, 30]]),
        "labels": np.array([1.0, 2.0, 3.0]),
        "scores": np.array([0.8, 0.95, 0.9]),
        "masks": masks,
    }
    shape = [1, 3, 32, 48] if batched else [3, 32, 48]
    path = constant_outputs(tmp_path / "plain.onnx", [("image", shape)], outputs)
    proposals = open_proposer(f"onnx:{path}").propose(np.zeros((64, 96, 3), np.uint8))
    assert proposals.scores.tolist() == pytest.approx([0.95])  # the third is nowhere above a half
    assert proposals.masks[0][9:39, 17:47].all()
    assert not proposals.masks[0][:7].any()


def test_the_detector_sees_the_image_in_grey_bars(tmp_path):
    """A graph whose mask is its own input's red channel."""
    nodes = [
        helper.make_node("Slice", ["image", "from", "to", "axis"], ["masks"]),
        helper.make_node("Identity", ["b"], ["boxes"]),
        helper.make_node("Identity", ["s"], ["scores"]),
    ]
    path = save(
        tmp_path / "red.onnx", nodes, [("image", [1, 3, 48, 48])],
        [("boxes", [1, 4]), ("scores", [1]), ("masks", [1, 1, 48, 48])],
        [("from", np.array([0])), ("to", np.array([1])), ("axis", np.array([1])),
         ("b", np.array([[0, 0, 48, 48]], np.float32)), ("s", np.ones(1, np.float32))],
    )  # fmt: skip
    image, light = bright_square()
    image[:, :, 1:] = 0
    proposals = open_proposer(f"onnx:{path}").propose(image)
    assert (proposals.masks[0] == light).mean() > 0.95


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        ({"a": np.zeros((1, 2))}, "expected boxes, scores and masks"),
        ({"output0": np.zeros((1, 5, 5)), "output1": np.zeros((1, 2, 16, 16))}, "as many coefficients"),
        ({"boxes": np.zeros((2, 4)), "scores": np.zeros(1), "masks": np.zeros((2, 8, 8))}, "expected as many"),
    ],
)
def test_other_outputs_are_refused(tmp_path, outputs, message):
    path = constant_outputs(tmp_path / "x.onnx", [("image", [1, 3, 64, 64])], outputs)
    with pytest.raises(SceneError, match=message):
        open_proposer(f"onnx:{path}").propose(np.zeros((30, 20, 3), np.uint8))


def test_no_model_and_a_model_of_another_size(tmp_path):
    with pytest.raises(SceneError, match="is no file"):
        open_proposer(f"onnx:{tmp_path / 'none.onnx'}")
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with pytest.raises(SceneError, match="cannot be opened"):
        open_proposer(f"onnx:{tmp_path / 'junk.onnx'}")
    with pytest.raises(SceneError, match="3 ONNX files"):
        open_proposer("onnx:a,b,c")
    assert issubclass(SceneError, OgPointcloudError)
