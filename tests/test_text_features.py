"""Text-feature files: what is read, and what each damaged one says."""

from __future__ import annotations

import numpy as np
import pytest

from og_pointcloud.errors import FeatureSpaceError
from og_pointcloud.text.text_features import read_text_features


def save(path, **entries):
    np.savez(path, **entries)
    return path


def good(**changes):
    entries = {"names": np.array(["a", "b"]), "vectors": np.eye(2, 3), "feature_space": np.array("space")}
    return {name: value for name, value in {**entries, **changes}.items() if value is not None}


def test_names_vectors_and_space_come_back(tmp_path):
    vocabulary, space = read_text_features(save(tmp_path / "t.npz", **good()))
    assert (vocabulary.names, space) == (("a", "b"), "space")
    assert vocabulary.vectors.dtype == np.float32
    assert (vocabulary.vectors == np.eye(2, 3)).all()


def test_a_compressed_file_is_read_too(tmp_path):
    np.savez_compressed(tmp_path / "t.npz", **good(vectors=np.asfortranarray([[1.0, 2], [3, 4]], np.float16)))
    assert read_text_features(tmp_path / "t.npz")[0].vectors.tolist() == [[1, 2], [3, 4]]


def test_a_file_that_names_no_space_is_unknown(tmp_path):
    assert read_text_features(save(tmp_path / "t.npz", **good(feature_space=None)))[1] == "unknown"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"names": None}, "lacks 1 of 2 arrays, e.g. 'names'"),
        ({"vectors": None}, "lacks 1 of 2 arrays, e.g. 'vectors'"),
        ({"names": np.array(["a", "a"])}, "'a' is given twice"),
        ({"names": np.array(["a", " "])}, "row 1 has an empty name"),
        ({"names": np.array([1, 2])}, "names are int64"),
        ({"names": np.array(["a"])}, r"vectors are float64 \(2, 3\); expected floats of shape \(1, D\)"),
        ({"vectors": np.ones(2)}, r"vectors are float64 \(2,\)"),
        ({"vectors": np.ones((2, 3), int)}, "vectors are int64"),
        ({"vectors": np.ones((2, 0))}, "at least one"),
        ({"vectors": np.array([[1, 2], [0, 0.0]])}, "vector of 'b' is zero"),
        ({"vectors": np.array([[np.nan, 2], [1, 0]])}, "vector of 'a' is NaN or infinite"),
        ({"vectors": np.array([[1e300, 2], [1, 0]])}, "vector of 'a' is NaN or infinite"),
    ],
)
def test_bad_entries_are_named(tmp_path, changes, says):
    path = save(tmp_path / "t.npz", **good(**changes))
    with pytest.raises(FeatureSpaceError, match=says) as caught:
        read_text_features(path)
    assert str(caught.value).startswith(str(path))


def test_pickled_names_are_never_loaded(tmp_path):
    with pytest.raises(FeatureSpaceError, match="Python objects"):
        read_text_features(save(tmp_path / "t.npz", **good(names=np.array(["a", "b"], object))))


def test_missing_file(tmp_path):
    with pytest.raises(FeatureSpaceError, match="is not a file"):
        read_text_features(tmp_path / "t.npz")


def test_a_file_that_unpacks_to_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr("og_pointcloud.text.text_features.MAX_UNPACKED_BYTES", 100)
    with pytest.raises(FeatureSpaceError, match="at most 100"):
        read_text_features(save(tmp_path / "t.npz", **good()))
