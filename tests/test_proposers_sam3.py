"""SAM 3's words and tracks: a tiny model with random weights in transformers' own format, made on the spot."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from text_models import MERGES, VOCABULARY, clip_tokenizer

from og_pointcloud.errors import SceneError
from og_pointcloud.masking.worker import open_proposer

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
if not hasattr(transformers, "Sam3VideoModel"):
    pytest.skip("this transformers has no SAM 3", allow_module_level=True)

from safetensors.torch import load_file, save_file  # noqa: E402

from og_pointcloud.masking import sam3  # noqa: E402
from og_pointcloud.masking.sam import SamPredictor, prepared  # noqa: E402

SIDE, WIDTH = 56, 128
WORDS = ("cat", "low lower")
IMAGES = np.random.default_rng(2).integers(0, 256, (10, 36, 60, 3)).astype(np.uint8)


def tiny_sam3():
    """Both halves, which take 56x56 pixels and five things a word; every one of them is a detection."""
    torch.manual_seed(0)
    backbone = {
        "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": SIDE, "patch_size": 14, "window_size": 2, "global_attn_indexes": [1],
        "pretrain_image_size": SIDE,
    }  # fmt: skip
    vision = {
        "model_type": "sam3_vision_model", "backbone_config": backbone, "fpn_hidden_size": WIDTH,
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
    }  # fmt: skip
    text = {
        "model_type": "clip_text_model", "vocab_size": VOCABULARY, "hidden_size": 32, "intermediate_size": 32,
        "projection_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "max_position_embeddings": 32,
        "bos_token_id": VOCABULARY - 2, "eos_token_id": VOCABULARY - 1,
    }  # fmt: skip
    half = {"hidden_size": WIDTH, "num_layers": 1, "num_attention_heads": 2, "intermediate_size": 32}
    detector = {
        "model_type": "sam3", "vision_config": vision, "text_config": text, "geometry_encoder_config": half,
        "detr_encoder_config": half, "detr_decoder_config": {**half, "num_queries": 5},
        "mask_decoder_config": {"hidden_size": WIDTH, "num_attention_heads": 2},
    }  # fmt: skip
    decoder = {
        "hidden_size": WIDTH, "mlp_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2,
        "iou_head_hidden_dim": 32,
    }  # fmt: skip
    memory = {
        "memory_attention_hidden_size": WIDTH, "memory_attention_num_layers": 1, "memory_encoder_hidden_size": WIDTH,
        "memory_attention_feed_forward_hidden_size": 32, "memory_attention_rope_feat_sizes": [4, 4],
        "mask_downsampler_embed_dim": WIDTH, "memory_fuser_embed_dim": WIDTH, "memory_fuser_intermediate_dim": 32,
        "memory_fuser_num_layers": 1, "max_object_pointers_in_encoder": 4,
    }  # fmt: skip
    prompt = {"hidden_size": WIDTH, "mask_input_channels": 4, "image_size": SIDE, "patch_size": 14}
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision, "prompt_encoder_config": prompt,
        "mask_decoder_config": decoder, "image_size": SIDE, **memory,
    }  # fmt: skip
    return transformers.Sam3VideoModel(transformers.Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=16, score_threshold_detection=0.0,
        new_det_thresh=0.0,
    )).eval()  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("sam3")
    tiny_sam3().save_pretrained(made)
    # As published: transformers 5.23 writes the prefix twice, and would answer points with weights drawn at random.
    weights = load_file(made / "model.safetensors")
    once = {name.replace("tracker_model.tracker_model.", "tracker_model."): weights[name] for name in weights}
    save_file(once, made / "model.safetensors", {"format": "pt"})
    (made / "tokenizer.json").write_text(json.dumps(clip_tokenizer(MERGES)))
    return made


@pytest.fixture
def trusting(monkeypatch):
    """Every detection counts: weights are random."""
    monkeypatch.setattr(sam3, "MIN_SCORE", 0.0)


def padded(proposer, to=12):
    """The words as transformers' own processor gives them, filled up and masked."""
    for tokens in proposer._tokens:
        ids = torch.nn.functional.pad(tokens, (0, to - tokens.shape[1]), value=VOCABULARY - 1)
        yield ids, torch.nn.functional.pad(torch.ones_like(tokens), (0, to - tokens.shape[1]))


def test_words_are_answered_as_the_model_itself_answers_them(folder, trusting):
    proposer = open_proposer(f"sam:{folder}", WORDS)
    proposals = proposer.propose(IMAGES[0])
    assert proposals.tracks is None
    model, expected, scores = tiny_sam3().detector_model, [], []
    pixels = prepared(IMAGES[0], proposer._loaded.preparation)
    with torch.inference_mode():
        for ids, mask in padded(proposer):
            said = model(pixel_values=pixels, input_ids=ids, attention_mask=mask)
            shown = torch.nn.functional.interpolate(said.pred_masks.sigmoid(), (36, 60), mode="bilinear")[0] > 0.5
            expected.append(shown.numpy())
            scores.append((said.pred_logits.sigmoid() * said.presence_logits.sigmoid())[0].numpy())
    expected, scores = np.concatenate(expected), np.concatenate(scores)
    shown = expected.any(axis=(1, 2))
    assert shown.sum() > 0
    assert (proposals.masks == expected[shown]).mean() > 0.999  # logits of 0 but for rounding fall to either side
    np.testing.assert_allclose(proposals.scores, scores[shown], atol=1e-5)


def test_what_the_model_does_not_trust_is_no_mask(folder):
    proposals = open_proposer(f"sam:{folder}", WORDS).propose(IMAGES[0])
    assert proposals.masks.shape == (0, 36, 60)


def test_tracks_are_those_of_the_whole_session_though_most_of_it_is_forgotten(folder):
    """Ten images, of which the tracker looks four back; transformers alone, which keeps all, says the same."""
    followed = open_proposer(f"sam:{folder}", WORDS[1:], 0)
    model = tiny_sam3()
    session = transformers.Sam3VideoInferenceSession(dtype=torch.float32)
    for word, (ids, mask) in zip(WORDS[1:], padded(open_proposer(f"sam:{folder}", WORDS[1:])), strict=True):
        prompt = session.add_prompt(word)
        session.prompt_input_ids[prompt], session.prompt_attention_masks[prompt] = ids, mask
    seen = 0
    for image in IMAGES:
        proposals = followed.propose(image)
        said = model(inference_session=session, frame=prepared(image, followed._loaded.preparation))
        assert set(proposals.tracks) <= set(said.object_ids)
        for track, mask in zip(proposals.tracks.tolist(), proposals.masks, strict=True):
            values = torch.nn.functional.interpolate(said.obj_id_to_mask[track][None], (36, 60), mode="bilinear")
            assert (mask == (values[0, 0] > 0).numpy()).mean() > 0.99
            seen += 1
    assert seen > len(IMAGES)
    last, kept = len(IMAGES) - 1, max(model.config.tracker_config.num_maskmem, 4)
    lengths = []
    for thing, outputs in followed._session.output_dict_per_obj.items():
        ours, theirs = outputs["non_cond_frame_outputs"], session.output_dict_per_obj[thing]["non_cond_frame_outputs"]
        lengths.append((len(ours), len(theirs)))
        if last in theirs:
            torch.testing.assert_close(ours[last]["pred_masks"], theirs[last]["pred_masks"], rtol=0, atol=1e-5)
    ours, theirs = np.array(lengths).T
    assert ours.max() <= kept < theirs.max() == last
    assert not followed._session.processed_frames


def test_runs_that_begin_elsewhere_have_tracks_of_their_own(folder):
    first, later = (open_proposer(f"sam:{folder}", WORDS, done).propose(IMAGES[0]).tracks for done in (0, 7))
    assert len(first) == len(later) > 0
    assert not set(first) & set(later)
    assert first.dtype == later.dtype == np.int64


def test_nothing_is_fetched_while_following(folder, monkeypatch):
    from transformers.models.sam3_video import modeling_sam3_video

    asked = []
    monkeypatch.setattr(modeling_sam3_video, "is_kernels_available", lambda: True)
    monkeypatch.setattr(modeling_sam3_video, "get_kernel", lambda *where, **_: asked.append(where), raising=False)
    monkeypatch.setattr(modeling_sam3_video, "cv_utils_kernel", None)
    proposer = open_proposer(f"sam:{folder}", WORDS, 0)
    proposer.propose(IMAGES[0])
    assert asked == []


def test_the_same_folder_answers_points(folder):
    predictor = SamPredictor(folder)
    weights, published = predictor.loaded.model.state_dict(), load_file(folder / "model.safetensors")
    answering = [name for name in weights if name.startswith("mask_decoder.")]
    assert len(answering) > 50
    assert all(torch.equal(weights[name], published[f"tracker_model.{name}"]) for name in answering)
    predictor.set_image(IMAGES[0])
    logits, iou = predictor.at_points(np.array([[10, 20]], np.float32))
    assert logits.shape[:2] == iou.shape == (1, 3)


@pytest.mark.parametrize(("change", "says"), [
    ("tokenizer", "has no tokenizer.json"), ("other tokenizer", "gives ids up to"), ("words", "words with SAM 3"),
    ("other proposer", "proposer 'opencv' is asked for words"), ("kind", "model_type is 'bert'; expected one of sam3"),
])  # fmt: skip
def test_what_is_missing_is_named(folder, tmp_path, change, says):
    model = tmp_path / "model"
    shutil.copytree(folder, model)
    if change == "tokenizer":
        (model / "tokenizer.json").unlink()
    if change == "other tokenizer":
        (model / "tokenizer.json").write_text(json.dumps(clip_tokenizer([*MERGES, ("d", "o"), ("do", "g</w>")])))
    if change == "kind":
        transformers.BertConfig().save_pretrained(model)
    name = "opencv" if change == "other proposer" else f"sam:{model}"
    words, followed = ((), 0) if change == "words" else (WORDS, None)
    with pytest.raises(SceneError, match=says):
        open_proposer(name, words, followed)
