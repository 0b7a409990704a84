"""LangSplat's language_features: four levels, cumulative ids, compacted rows."""

import warnings

import numpy as np
import pytest

from og_pointcloud.errors import SceneError
from og_pointcloud.formats.langsplat import LANGSPLAT_SPACE, LEVELS, read_language_features

HEIGHT, WIDTH = 24, 32


def literal_levels(seed=0, counts=(3, 6, 4, 2), width=512, empty=()):
    """Ids of four levels that count on, one feature row each, as LangSplat's script stacks them."""
    rng = np.random.default_rng(seed)
    levels = np.full((4, HEIGHT, WIDTH), -1.0, np.float32)
    start = 0
    for index, count in enumerate(counts):
        local = rng.integers(-1, count, (HEIGHT, WIDTH))
        if LEVELS[index] not in empty:
            levels[index] = np.where(local < 0, -1, local + start)
        start += count
    return levels, rng.normal(size=(start, width)).astype(np.float16)


def write(tmp_path, views):
    folder = tmp_path / "language_features"
    folder.mkdir(exist_ok=True)
    for name, (levels, features) in views.items():
        np.save(folder / f"{name}_s.npy", levels)
        np.save(folder / f"{name}_f.npy", features)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.int64])
def test_every_pixel_keeps_its_feature(tmp_path, level, dtype):
    levels, features = literal_levels()
    of_level = levels[LEVELS.index(level)]
    of_level[of_level == of_level.max() - 1] = -1
    write(tmp_path, {"a": (levels.astype(dtype), features)})
    (layer,), space = read_language_features(tmp_path, ["a"], level)
    assert space == LANGSPLAT_SPACE
    assert layer.size == (WIDTH, HEIGHT)
    rows = layer.read()
    assert rows.dtype == np.int32
    assert layer.features.dtype == np.float32
    ids = of_level.astype(int)
    np.testing.assert_array_equal(rows < 0, ids < 0)
    np.testing.assert_array_equal(layer.features[rows[ids >= 0]], features[ids[ids >= 0]].astype(np.float32))
    assert len(layer.features) == len(np.unique(ids[ids >= 0])), "rows that no pixel of the level shows are left out"


def test_masks_are_read_when_asked_for(tmp_path):
    write(tmp_path, {"a": literal_levels()})
    (layer,), _ = read_language_features(tmp_path, ["a"], "large")
    (tmp_path / "language_features/a_s.npy").unlink()
    with pytest.raises(SceneError, match=r"a_s.npy cannot be read"):
        layer.read()


NOTHING = np.full((4, HEIGHT, WIDTH), -1.0, np.float32), np.zeros((0, 512), np.float32)


@pytest.mark.parametrize("other", [literal_levels(empty=("large",)), NOTHING])
def test_a_view_without_this_level_stays_without_masks(tmp_path, other):
    write(tmp_path, {"a": literal_levels(), "b": other})
    with pytest.warns(UserWarning, match="1 of 2 views have no mask at level 'large', e.g. 'b'"):
        layers, _ = read_language_features(tmp_path, ["a", "b"], "large")
    assert layers[1].features.shape == (0, 512)
    assert (layers[1].read() == -1).all()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if other is NOTHING else "error")
        read_language_features(tmp_path, ["a", "b"], "small")


def test_no_view_with_this_level_is_an_error(tmp_path):
    write(tmp_path, {"b": literal_levels(empty=("large",))})
    with pytest.raises(
        SceneError, match="no view has a mask at level 'large'; expected masks: choose another of default"
    ):
        read_language_features(tmp_path, ["b"], "large")


def test_feature_space(tmp_path):
    write(tmp_path, {"a": literal_levels(width=16)})
    assert read_language_features(tmp_path, ["a"], "large")[1] == "unknown", "16-d features are not LangSplat's CLIP"
    (tmp_path / "language_features/feature_space.txt").write_text("my-clip\n")
    assert read_language_features(tmp_path, ["a"], "large")[1] == "my-clip"
    (tmp_path / "language_features/feature_space.txt").write_bytes(b"\xff")
    with pytest.raises(SceneError, match="cannot be read as text"):
        read_language_features(tmp_path, ["a"], "large")


def test_feature_space_of_the_captures_own_words(tmp_path):
    write(tmp_path, {"a": literal_levels()})
    words = tmp_path / "text_features.npz"
    np.savez(words, names=["chair"], vectors=np.ones((1, 512), np.float32), feature_space="my-clip")
    assert read_language_features(tmp_path, ["a"], "large")[1] == "my-clip"
    np.savez(words, names=["chair"], vectors=np.ones((1, 16), np.float32), feature_space="my-clip")
    assert read_language_features(tmp_path, ["a"], "large")[1] == LANGSPLAT_SPACE, "of another width"
    np.savez(words, names=["chair"], vectors=np.ones((1, 512), np.float32))
    assert read_language_features(tmp_path, ["a"], "large")[1] == LANGSPLAT_SPACE, "words of no named space say nothing"


def test_an_unknown_level_is_refused(tmp_path):
    with pytest.raises(SceneError, match="mask level is 'huge'; expected one of default, small, medium, large"):
        read_language_features(tmp_path, ["a"], "huge")


@pytest.mark.parametrize(("suffix", "other"), [("_s", "_f"), ("_f", "_s")])
def test_a_missing_file_is_named(tmp_path, suffix, other):
    write(tmp_path, {"a": literal_levels(), "b": literal_levels()})
    (tmp_path / f"language_features/b{suffix}.npy").unlink()
    assert (tmp_path / f"language_features/b{other}.npy").exists()
    with pytest.raises(SceneError, match=rf"1 of 2 posed images have no mask: .*language_features lacks b{suffix}.npy"):
        read_language_features(tmp_path, ["a", "b"], "large")


def restart(levels):
    levels[3] = np.where(levels[3] >= 0, levels[3] - levels[3].max() + 1, -1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda levels: levels[3].__setitem__((0, 0), 15),
            r"mask id 15 of level 'large' has no feature row .* has 15\)",
        ),
        (lambda levels: levels[3].__setitem__((0, 0), np.nan), "has values that are not ids"),
        (lambda levels: levels[3].__setitem__((0, 0), 3.5), "has values that are not ids"),
        (lambda levels: levels[3].__setitem__((0, 0), 1e20), "has values that are not ids"),
        (restart, "the ids of level 'large' start at 0 again"),
    ],
)
def test_bad_ids_are_refused(tmp_path, change, message):
    levels, features = literal_levels()
    change(levels)
    write(tmp_path, {"a": (levels, features)})
    with pytest.raises(SceneError, match=message):
        read_language_features(tmp_path, ["a"], "large")


@pytest.mark.parametrize("level", ["default", "small", "medium", "large"])
def test_one_map_written_for_all_levels_is_read(tmp_path, level):
    levels, features = literal_levels()
    levels[:] = levels[0]
    write(tmp_path, {"a": (levels, features)})
    (layer,), _ = read_language_features(tmp_path, ["a"], level)
    assert np.array_equal(layer.read(), levels[0])
    assert np.array_equal(layer.features, features[: int(levels[0].max()) + 1].astype(layer.features.dtype))


@pytest.mark.parametrize(
    ("levels", "features", "message"),
    [
        (np.zeros((3, 4, 4)), np.zeros((2, 8)), r"\(3, 4, 4\); expected numbers \(4, height, width\)"),
        (np.zeros((4, 4)), np.zeros((2, 8)), r"\(4, 4\); expected numbers"),
        (np.zeros((4, 4, 4), "U2"), np.zeros((2, 8)), "expected numbers"),
        (np.zeros((4, 4, 4)), np.zeros(8), r"\(8,\); expected floats of shape \(masks, dimension\)"),
        (np.zeros((4, 4, 4)), np.zeros((2, 8), int), "expected floats"),
        (np.array([{}]), np.zeros((2, 8)), "cannot be read as a .npy array"),
    ],
)
def test_other_arrays_are_refused(tmp_path, levels, features, message):
    write(tmp_path, {"a": (levels, features)})
    with pytest.raises(SceneError, match=message):
        read_language_features(tmp_path, ["a"], "default")


@pytest.mark.parametrize("size", [0, 5, 100, 400, 4000])
@pytest.mark.parametrize("suffix", ["_s", "_f"])
def test_truncated_files_are_refused(tmp_path, size, suffix):
    write(tmp_path, {"a": literal_levels()})
    file = tmp_path / f"language_features/a{suffix}.npy"
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(SceneError, match=rf"a{suffix}.npy cannot be read as a .npy array .* truncated"):
        read_language_features(tmp_path, ["a"], "large")
