"""Pictures of a training, against what each stage's panel must show."""

import cv2
import numpy as np
import pytest

from og_pointcloud.show.fit_pictures import training_picture


def test_a_training_is_drawn_stage_by_stage(tmp_path):
    stages = [
        {"stage": name, "steps": 10, "published_steps": 20_000, "loss": loss}
        for name, loss in (("features", [1.0, 0.5, 0.25]), ("coarse codebook", [2.0, 0.0]), ("fine codebook", [0.1]))
    ]
    picture = cv2.imread(str(training_picture(stages, tmp_path / "t.png")))[:, :, ::-1].astype(int)
    assert picture.shape[1] == 3 * 360
    blue = picture[:, :, 2] - picture[:, :, 0] > 80
    first, second, third = (blue[:, 360 * panel : 360 * (panel + 1)] for panel in range(3))
    heights = [np.argwhere(first[:, column])[:, 0].mean() for column in (12, 178, 346)]
    assert np.diff(heights) == pytest.approx([100, 50], abs=4), "from one to a half to a quarter of 200 pixels"
    assert second.any()
    assert third.any()
