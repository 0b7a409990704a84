"""Results of OpenGaussian runs, written here in its layout, become labelled clouds; damaged ones are named."""

import io
import zipfile

import numpy as np
import pytest

from og_pointcloud.ask.labelled_scene import LabelledScene, segment
from og_pointcloud.cloud import UNKNOWN_SPACE
from og_pointcloud.errors import SceneError
from og_pointcloud.fitting import opengaussian
from og_pointcloud.fitting.opengaussian import read_opengaussian
from og_pointcloud.formats.gaussian_ply import BASE_COLOR, LOG_SCALE, ROTATION
from og_pointcloud.formats.langsplat import LANGSPLAT_SPACE
from og_pointcloud.formats.ply import join_columns, write_ply
from og_pointcloud.formats.points import read_points

COUNT, LEAVES, WIDTH = 300, 12, 8
INSTANCE_FEATURES = ("ins_feat_r", "ins_feat_g", "ins_feat_b", "ins_feat_r2", "ins_feat_g2", "ins_feat_b2")
ORIGIN = np.array([4e5, -3e5, 20.0])


def leaf_arrays(seed=0):
    """Leaves 0, 3, 6, ... hold Gaussians; leaf 3 has a zero row, leaf 6 no view."""
    random = np.random.default_rng(seed)
    features = 5 * random.normal(size=(LEAVES, WIDTH)).astype(np.float32)
    features[3] = 0
    views = np.arange(LEAVES) + 2
    views[[3, 6]] = 0
    return {
        "leaf_feat": features,
        "leaf_score": np.linspace(-0.5, 1.5, LEAVES).astype(np.float32),
        "occu_count": views,
        "leaf_ind": 3 * (np.arange(COUNT) % 4),
    }


def write_result(folder, arrays=None, iterations=(30_000, 90_000), seed=0):
    """A result folder; the Gaussians of earlier iterations lie elsewhere. Returns world coordinates and opacities."""
    random = np.random.default_rng(seed)
    xyz = random.random((COUNT, 3)) + ORIGIN
    logit = np.where(np.arange(COUNT) % 10 == 0, -4.0, 2.0)
    for iteration in iterations:
        last = iteration == max(iterations)
        groups = {("x", "y", "z"): xyz if last else xyz + 1000, ("nx", "ny", "nz"): np.zeros((COUNT, 3))}
        groups[INSTANCE_FEATURES] = random.random((COUNT, 6)).astype(np.float32)
        groups[BASE_COLOR] = random.normal(size=(COUNT, 3)).astype(np.float32)
        groups |= {("opacity",): logit[:, None], LOG_SCALE: np.full((COUNT, 3), -3.0)}
        groups[ROTATION] = np.tile([2.0, 0.0, 0.0, 0.0], (COUNT, 1))
        path = folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        path.parent.mkdir(parents=True)
        columns = {name: values[:, i] for names, values in groups.items() for i, name in enumerate(names)}
        write_ply(path, {"vertex": join_columns(columns)})
    arrays = leaf_arrays() if arrays is None else arrays
    np.savez(folder / "cluster_lang.npz", **arrays)
    return xyz, 1 / (1 + np.exp(-logit))


@pytest.fixture
def result(tmp_path):
    write_result(tmp_path / "run")
    return tmp_path / "run"


def test_a_plain_cloud_is_refused(result, tmp_path):
    write_ply(tmp_path / "plain.ply", {"vertex": join_columns(dict.fromkeys("xyz", np.zeros(COUNT)))})
    with pytest.raises(SceneError, match=r"plain.ply is a plain cloud; expected the trained Gaussians of the run"):
        read_opengaussian(tmp_path / "plain.ply", result / "cluster_lang.npz")


def test_leaves_become_instances(tmp_path):
    xyz, opacity = write_result(tmp_path)
    cloud = read_opengaussian(tmp_path, feature_space="a space")
    kept = opacity >= 0.1
    assert kept.sum() == 270
    assert np.abs(cloud.xyz_world - xyz[kept]).max() < 1e-6
    assert np.array_equal(cloud.instance_ids, (np.arange(COUNT) % 4)[kept]), "leaves 0, 3, 6, 9 are 0, 1, 2, 3"
    arrays, used = leaf_arrays(), [0, 3, 6, 9]
    table = cloud.instances
    assert table.descriptor_instance.tolist() == [0, 3], "no feature for a zero row, nor for a leaf that no view saw"
    unit = arrays["leaf_feat"][[0, 9]] / np.linalg.norm(arrays["leaf_feat"][[0, 9]], axis=1, keepdims=True)
    assert np.allclose(table.descriptors, unit, atol=1e-6)
    assert np.array_equal(table.points, np.bincount(cloud.instance_ids))
    assert table.views.tolist() == table.masks.tolist() == arrays["occu_count"][used].tolist()
    assert np.allclose(table.agreement, np.clip(arrays["leaf_score"][used], -1, 1))
    assert cloud.feature_space == "a space"
    ply = tmp_path / "point_cloud" / "iteration_90000" / "point_cloud.ply"
    assert np.array_equal(cloud.rgb, read_points(ply).rgb[kept])
    assert cloud.provenance["notes"] == {"leaves": LEAVES, "instances": 4, "instances_without_feature": 2}


def test_leaves_without_a_feature_answer_unknown(result):
    cloud = read_opengaussian(result)
    labels = segment(LabelledScene.from_cloud(cloud), {"a": np.ones(WIDTH), "b": -np.ones(WIDTH)}).labels
    assert (labels[np.isin(cloud.instance_ids, [1, 2])] == -1).all()
    assert (labels[np.isin(cloud.instance_ids, [0, 3])] >= 0).all()


def test_all_gaussians_can_be_kept_in_their_order(tmp_path):
    xyz, _ = write_result(tmp_path)
    cloud = read_opengaussian(tmp_path, min_opacity=0)
    assert np.abs(cloud.xyz_world - xyz).max() < 1e-6
    assert np.array_equal(cloud.instance_ids, np.arange(COUNT) % 4)


def test_ply_and_npz_can_be_named(result, tmp_path):
    whole = read_opengaussian(result)
    ply = result / "point_cloud" / "iteration_90000" / "point_cloud.ply"
    assert np.array_equal(read_opengaussian(ply).instance_ids, whole.instance_ids)
    elsewhere = (result / "cluster_lang.npz").rename(tmp_path / "other.npz")
    assert np.array_equal(read_opengaussian(ply, elsewhere).instance_ids, whole.instance_ids)


def test_names_that_end_in_npy_twice_and_column_vectors_are_read(tmp_path):
    arrays = leaf_arrays()
    for name in ("leaf_score", "occu_count", "leaf_ind"):
        arrays[name] = arrays[name][:, None]
    write_result(tmp_path, {f"{name}.npy": values for name, values in arrays.items()})
    assert len(read_opengaussian(tmp_path).instances) == 4


def test_feature_space_is_told_by_the_width(tmp_path):
    arrays = leaf_arrays()
    write_result(tmp_path / "narrow", arrays)
    arrays["leaf_feat"] = np.ones((LEAVES, 512), np.float16)
    write_result(tmp_path / "clip", arrays)
    assert read_opengaussian(tmp_path / "narrow").feature_space == UNKNOWN_SPACE
    assert read_opengaussian(tmp_path / "clip").feature_space == LANGSPLAT_SPACE


def changed(name, change):
    arrays = leaf_arrays()
    arrays[name] = change(arrays[name])
    return arrays


def with_value(values, at, value):
    values = values.astype(np.float32) if isinstance(value, float) else values.copy()
    values[at] = value
    return values


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        (
            changed("leaf_ind", lambda v: with_value(v, 5, LEAVES)),
            "leaf_ind row 5 is 12; expected numbers from 0 to 11",
        ),
        (changed("leaf_ind", lambda v: with_value(v, 7, -1)), "leaf_ind row 7 is -1"),
        (changed("leaf_ind", lambda v: v[:-1]), r"expected integers of shape \(300,\)"),
        (changed("leaf_ind", lambda v: v + 0.5), "leaf_ind is float64"),
        (changed("leaf_feat", lambda v: with_value(v, (4, 2), np.nan)), r"leaf_feat row 4 is .*nan"),
        (changed("leaf_feat", lambda v: v[0]), r"expected floats of shape \(leaves, D\)"),
        (changed("leaf_score", lambda v: with_value(v, 1, np.inf)), "leaf_score row 1 is inf"),
        (changed("leaf_score", lambda v: v[:5]), r"leaf_score is float32 \(5,\); expected numbers of shape \(12,\)"),
        (changed("occu_count", lambda v: v - 5), "occu_count row 0 is -3"),
        (changed("occu_count", lambda v: v * 1e30), "occu_count row 0 is 2e"),
        (changed("occu_count", lambda v: v.astype(object)), "Python objects"),
        ({"leaf_feat": np.ones((2, 2))}, "lacks 3 of 4 arrays, e.g. 'leaf_score'"),
    ],
)
def test_bad_arrays_are_named(tmp_path, arrays, text):
    write_result(tmp_path, arrays)
    with pytest.raises(SceneError, match=text) as caught:
        read_opengaussian(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "cluster_lang.npz"))


def test_missing_and_damaged_files_are_named(result, tmp_path):
    with pytest.raises(SceneError, match="empty is not a file; expected an OpenGaussian result folder"):
        read_opengaussian(tmp_path / "empty")
    data = (result / "cluster_lang.npz").read_bytes()
    (result / "cluster_lang.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(SceneError, match="cannot be read as"):
        read_opengaussian(result)
    (result / "cluster_lang.npz").unlink()
    with pytest.raises(SceneError, match="--cluster-lang"):
        read_opengaussian(result)


def test_invisible_clouds_are_refused(result):
    with pytest.raises(SceneError, match=r"the 300 Gaussians has an opacity of 0.99 or more \(the largest is 0.88"):
        read_opengaussian(result, min_opacity=0.99)


def test_huge_entries_are_refused_before_they_are_unpacked(result, monkeypatch):
    monkeypatch.setattr(opengaussian, "MAX_UNPACKED_BYTES", 1000)
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("an entry was unpacked"))
    with pytest.raises(SceneError, match="expected at most 1000"):
        read_opengaussian(result)


def test_a_header_that_claims_more_than_it_holds_is_refused(result):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (1 << 40, 512)})
    arrays = {name: io.BytesIO() for name in leaf_arrays()}
    for name, values in leaf_arrays().items():
        np.save(arrays[name], values)
    arrays["leaf_feat"] = stream
    with zipfile.ZipFile(result / "cluster_lang.npz", "w") as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data.getvalue())
    with pytest.raises(SceneError, match="its header claims"):
        read_opengaussian(result)


@pytest.mark.parametrize("iterations", [(30_000, 90_000), (30_000, 40_000, 50_000, 70_000)], ids=["scannet", "lerf"])
@pytest.mark.parametrize("second_codebook", [True, False])
def test_what_a_training_leaves_beside_its_result_is_passed_by(tmp_path, iterations, second_codebook):
    """Both data sets' iterations, the codebooks of each, and one that stopped before the second."""
    xyz, opacity = write_result(tmp_path, iterations=iterations)
    for iteration in iterations[1:]:
        for name in ("root_code_book", "leaf_code_book")[: 2 if second_codebook else 1]:
            folder = tmp_path / "point_cloud" / f"iteration_{iteration}" / name
            folder.mkdir()
            (folder / "kmeans_centers.pth").write_bytes(b"not to be read")
    (tmp_path / "cfg_args").write_text("Namespace(sh_degree=3)")
    (tmp_path / "cameras.json").write_text("[]")
    cloud = read_opengaussian(tmp_path)
    assert np.abs(cloud.xyz_world - xyz[opacity >= 0.1]).max() < 1e-6, "of the last iteration"
    assert len(cloud.instances) == 4
