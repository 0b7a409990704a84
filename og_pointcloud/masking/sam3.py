"""SAM 3 with word prompts, through transformers: a mask for each thing that a word names, in one image or tracked.

Words go through the model's own tokenizer.json, read like all others (`text.tokenizer`), and are not padded, as the
model masks padding anyway. For tracking, transformers would fetch code from elsewhere, which is prevented here. Without
that code overlapping tracks are not suppressed, but `levels` resolves the overlaps of an image's masks.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.masking.contracts import Proposals
from og_pointcloud.masking.pretrained import torch, transformers
from og_pointcloud.masking.sam import LoadedModel, load_sam
from og_pointcloud.text.tokenizer import open_tokenizer

MIN_SCORE = 0.5
"""Minimum score of a detection, as in transformers' examples. A tracker takes its own from its configuration."""
TRACK_IDS_PER_IMAGE = 1 << 32
"""A run's track numbers start at images_before times this, so that no two runs share a number."""


class NamedThings:
    """A proposer of the things that words name in a single image."""

    def __init__(self, name: StrPath, words: Sequence[str]) -> None:
        """name: as for `sam.SamPredictor`, of a SAM 3. words: at least one. SceneError where they cannot be used."""
        self._loaded = load_sam(name, {"sam3": "Sam3Model", "sam3_video": "Sam3Model"})
        self._tokens = _tokens(self._loaded, words)

    @torch.inference_mode()
    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB."""
        model, masks, scores = self._loaded.model, [], []
        seen = model.get_vision_features(pixel_values=self._loaded.pixels(image))
        for tokens in self._tokens:
            answer = model(vision_embeds=seen, input_ids=tokens, attention_mask=torch.ones_like(tokens))
            # A query's score: the probability that it is such a thing, times that of the image showing one.
            score = (answer.pred_logits.sigmoid() * answer.presence_logits.sigmoid())[0]
            kept = score > MIN_SCORE
            masks.append(answer.pred_masks[0, kept].sigmoid() - 0.5)
            scores.append(score[kept])
        return _proposals(torch.cat(masks), torch.cat(scores), image)


class FollowedWords:
    """A proposer of the things that words name in consecutive images, with their tracks."""

    def __init__(self, name: StrPath, words: Sequence[str], images_before: int = 0) -> None:
        """As `NamedThings`, with a SAM 3 that has its tracker. images_before: number of images of earlier runs, so
        that this run's tracks get other numbers than theirs."""
        self._loaded = load_sam(name, {"sam3_video": "Sam3VideoModel"})
        self._first = images_before * TRACK_IDS_PER_IMAGE
        # The value that transformers sets if the download fails; without it, code would be downloaded and run.
        sys.modules[type(self._loaded.model).__module__].cv_utils_kernel = False  # pyright: ignore
        device, self._step = self._loaded.device, 0
        self._session: Any = transformers.Sam3VideoInferenceSession(
            inference_device=device, inference_state_device=device, video_storage_device=device, dtype=torch.float32
        )
        for word, tokens in zip(words, _tokens(self._loaded, words), strict=True):
            prompt = self._session.add_prompt(word)
            self._session.prompt_input_ids[prompt] = tokens
            self._session.prompt_attention_masks[prompt] = torch.ones_like(tokens)

    @torch.inference_mode()
    def propose(self, image: NDArray[np.uint8]) -> Proposals:
        """image: (H, W, 3) uint8 RGB, the next one."""
        pixels = self._loaded.pixels(image)
        seen = self._loaded.model(inference_session=self._session, frame=pixels, frame_idx=self._step)
        self._forget()
        self._step += 1
        # Tracks that the tracker itself suppresses in this image, or has removed.
        hidden = {*(seen.suppressed_obj_ids or ()), *(seen.removed_obj_ids or ())}
        tracks = [track for track in sorted(seen.obj_id_to_mask) if track not in hidden]
        masks = [torch.zeros((0, 1, 1)), *(seen.obj_id_to_mask[track].float().cpu() for track in tracks)]
        scores = torch.tensor([float(seen.obj_id_to_score[track]) for track in tracks])
        return _proposals(torch.cat(masks[1:] or masks), scores, image, self._first + np.array(tracks, np.int64))

    def _forget(self) -> None:
        """Free images older than the tracker looks back: each takes 12 MB, plus 1 MB per thing in it."""
        tracker = self._loaded.model.config.tracker_config
        oldest = self._step - max(tracker.max_object_pointers_in_encoder, tracker.num_maskmem)
        self._session.processed_frames.pop(self._step)
        for outputs in self._session.output_dict_per_obj.values():
            outputs["non_cond_frame_outputs"].pop(oldest, None)


def _tokens(loaded: LoadedModel, words: Sequence[str]) -> list[torch.Tensor]:
    """(1, T) ids of each word."""
    file = loaded.folder / "tokenizer.json"
    if not file.is_file():
        raise SceneError(f"{loaded.folder} has no tokenizer.json, which words need: fetch the complete model again")
    config = getattr(loaded.model.config, "detector_config", loaded.model.config).text_config
    try:
        tokenizer = open_tokenizer(file.read_bytes(), config.max_position_embeddings, config.vocab_size)
    except ValueError as error:
        raise SceneError(f"{file} cannot be used ({error}): fetch the model again") from None
    return [torch.tensor([tokenizer(word)], device=loaded.device) for word in words]


def _proposals(
    values: torch.Tensor, scores: torch.Tensor, image: NDArray[np.uint8], tracks: NDArray[np.int64] | None = None
) -> Proposals:
    """Masks where values (n, h, w) are above 0, at the image's size; those without a pixel are left out."""
    size = image.shape[:2]
    if not len(values):
        return Proposals(np.zeros((0, *size), np.bool_), np.zeros(0, np.float32), tracks)
    masks = torch.nn.functional.interpolate(values[None], size, mode="bilinear", align_corners=False)[0] > 0
    shown = masks.any(dim=(1, 2)).cpu().numpy()
    found = masks.cpu().numpy()[shown], scores.float().cpu().numpy()[shown].clip(0, 1)
    return Proposals(*found, None if tracks is None else tracks[shown])
