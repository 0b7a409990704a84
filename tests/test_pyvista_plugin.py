"""The PyVista plugin: what datasets and plotters answer, held against numpy and the core; drawing is looked at."""

import runpy
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from labelled_clouds import WORDS, make_cloud, room
from og_pointcloud_export import write_bundle

import og_pointcloud as og
from og_pointcloud.formats.colors import label_colors

pv = pytest.importorskip("pyvista")

from og_pointcloud_pyvista import can_render, to_pyvista  # noqa: E402
from og_pointcloud_pyvista.datasets import box_lines  # noqa: E402
from og_pointcloud_pyvista.plotting import HIGHLIGHT, UNKNOWN_COLOR, font_file  # noqa: E402

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(scope="module")
def drawing():
    if not can_render():
        pytest.skip("VTK cannot draw off-screen here")


@pytest.fixture
def plotter(drawing):
    plotter = pv.Plotter(off_screen=True, window_size=[400, 300])
    yield plotter
    plotter.close()


def grids(scene):
    """Datasets of every kind in the scene's frame."""
    low, high = scene.xyz.min(axis=0), scene.xyz.max(axis=0)
    image = pv.ImageData(dimensions=(9, 8, 5), spacing=(high - low) / [8, 7, 4], origin=low)
    return {
        "cloud": pv.PolyData(scene.xyz),
        "points alone": pv.PointSet(scene.xyz),
        "surface": pv.Plane(center=(1, 1, 0), i_size=2, j_size=2, i_resolution=9, j_resolution=9),
        "image": image,
        "structured": image.cast_to_structured_grid(),
        "unstructured": image.cast_to_unstructured_grid(),
    }


def test_entry_points_bring_everything_without_an_import(bundle):
    code = f"""
import sys, pyvista as pv
assert "og_pointcloud" not in sys.modules and "og_pointcloud_pyvista" not in sys.modules
mesh = pv.read({str(bundle)!r})
print(mesh.n_points, (mesh.og.segment(["apple", "pear"])["og_label"] >= 0).sum(), hasattr(pv.Plotter, "og"))
print(type(pv.Plotter(off_screen=True).og).__name__)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    expected = og.segment(bundle, ["apple", "pear"])
    assert done.stdout.splitlines() == [f"{len(expected)} {(expected.labels >= 0).sum()} True", "OgPlotter"]


@pytest.mark.parametrize("kind", ["cloud", "points alone", "surface", "image", "structured", "unstructured"])
def test_every_kind_of_dataset_answers_as_arrays_do(scene, kind):
    mesh = grids(scene)[kind]
    before = list(mesh.array_names)
    labelled = mesh.og.segment(["plum", "apple"], scene)
    expected = og.segment(np.asarray(mesh.points), ["plum", "apple"], scene)
    assert type(labelled) is type(mesh)
    assert (labelled.n_points, labelled.n_cells) == (mesh.n_points, mesh.n_cells)
    assert mesh.array_names == before, "the dataset asked stays as it is"
    for name, column in {**expected.attributes, "og_color": expected.colors}.items():
        array = np.asarray(labelled.point_data[name])
        assert array.dtype == column.dtype
        assert np.array_equal(array, column), name
    assert tuple(labelled.field_data["og_names"]) == ("plum", "apple")
    assert (expected.labels >= 0).any()


def test_names_and_the_scene_travel_with_the_dataset_and_its_files(bundle, tmp_path):
    mesh = pv.PolyData(og.load(bundle).xyz[::3]).og.segment(["café", "red ball"], bundle)
    mesh.save(tmp_path / "labelled.vtp")
    again = pv.read(tmp_path / "labelled.vtp")
    assert tuple(again.field_data["og_names"]) == ("café", "red ball")
    assert np.array_equal(again.og.segment(["pear"])["og_instance"], mesh["og_instance"]), "no scene is given"
    in_memory = mesh.og.segment(["pear"], og.LabelledScene.from_cloud(room()))
    assert "og_pointcloud_scene" not in in_memory.field_data, "another scene answered"
    assert tuple(in_memory.field_data["og_names"]) == ("pear",)


def test_a_result_converts_with_and_without_points(scene):
    result = og.segment(scene.xyz[:50], None, scene)
    mesh = to_pyvista(result)
    assert mesh.points.dtype == np.float64
    assert np.array_equal(mesh.points, result.xyz)
    assert tuple(mesh.field_data["og_names"]) == WORDS
    with pytest.warns(UserWarning, match="0 points"):
        empty = to_pyvista(og.segment(np.zeros((0, 3)), ["apple"], scene))
    assert empty.n_points == 0
    assert tuple(empty.field_data["og_names"]) == ("apple",)


@pytest.mark.parametrize("make", [lambda path: og.segment(path, ["apple"]).to_pyvista(), pv.read])
def test_an_edited_mesh_changes_no_later_answer(bundle, make):
    before = og.segment(bundle, ["apple"])
    mesh = make(bundle)
    mesh.points += [100, 0, 0]
    for name in mesh.point_data:
        mesh[name][...] = 0
    after = og.segment(bundle, ["apple"])
    for name in ("xyz", "labels", "scores", "instances"):
        assert np.array_equal(getattr(after, name), getattr(before, name)), name


def test_an_edited_mesh_leaves_its_result(scene):
    result = og.segment(scene.xyz[:50], ["apple"], scene)
    kept = [result.xyz.copy(), result.labels.copy()]
    mesh = result.to_pyvista()
    mesh.points += [100, 0, 0]
    mesh["og_label"][...] = 7
    assert np.array_equal(result.xyz, kept[0])
    assert np.array_equal(result.labels, kept[1])


def test_nothing_labelled_is_said(scene):
    far = pv.PolyData(scene.xyz + 100)
    with pytest.warns(UserWarning, match="too far from the scene"):
        assert (far.og.segment(["apple"], scene)["og_label"] == -1).all()
    with pytest.warns(UserWarning, match="0 points"):
        pv.PolyData().og.segment(["apple"], scene)
    with pytest.raises(og.OgPointcloudError, match=r"'pairs' is not among the 5 known words.*did you mean 'pear'"):
        far.og.segment(["pairs"], scene)


def test_the_scene_is_found_as_everywhere(scene, bundle):
    mesh = pv.PolyData(scene.xyz[:20])
    with pytest.raises(og.OgPointcloudError, match="no scene to query"):
        mesh.og.segment(["apple"])
    assert np.array_equal(mesh.og.segment(["apple"], bundle)["og_instance"], scene.instance_ids[:20])


def test_select_extracts_the_fitting_instances_with_their_scores(scene):
    mesh = pv.PolyData(scene.xyz)
    selection = og.select(scene, "plum")
    points = mesh.og.select("plum", scene)
    assert len(selection.instances) > 1
    expected = np.flatnonzero(np.isin(scene.instance_ids, selection.instances))
    assert np.allclose(points.points, scene.xyz[expected])
    for match in selection.fitting:
        rows = points["og_instance"] == match.instance
        assert (points["og_score"][rows] == np.float32(match.score)).all()
    assert "og_instance" not in mesh.point_data


@pytest.mark.parametrize("kind", ["cloud", "points alone", "image", "structured", "unstructured"])
def test_select_finds_points_that_make_up_no_cell(scene, kind):
    mesh = grids(scene)[kind]
    expected = np.isin(scene.instances_at(np.asarray(mesh.points)), og.select(scene, "plum").instances)
    assert expected.any()
    assert np.allclose(mesh.og.select("plum", scene).points, mesh.points[expected])


def test_selecting_nothing_says_what_is_closest(scene):
    mesh = pv.PolyData(scene.xyz)
    vectors = {"nothing": -scene.cloud.instances.descriptors.sum(axis=0)}
    with pytest.warns(UserWarning, match=r"no point .* is selected: 'nothing' fits 0 of 8 instances\n"):
        assert mesh.og.select(vectors, scene).n_points == 0
    with pytest.warns(UserWarning, match=r"no point .* is selected: 'plum' fits \d of 8"):
        assert pv.PolyData(scene.xyz + 50).og.select("plum", scene).n_points == 0


def test_boxes_are_the_instances_own(scene, monkeypatch):
    mesh = pv.PolyData(scene.xyz).og.segment(["apple", "pear", "plum"], scene)
    table, tables = og.instance_table, []
    with monkeypatch.context() as patch:
        patch.setattr(og, "instance_table", lambda *given, **options: tables.append(0) or table(*given, **options))
        lines = mesh.og.boxes(scene, up=(0, 0, 1))
    assert len(tables) == 1, "a table for each box makes them wait for minutes"
    assert pv.PolyData().og.boxes(scene).n_cells == 0
    labelled = np.unique(mesh["og_instance"][mesh["og_label"] >= 0])
    assert np.array_equal(np.unique(lines["og_instance"]), labelled)
    assert lines.n_cells == 12 * len(labelled)
    for number, instance in enumerate(labelled):
        box = og.instance_table(scene, up=(0, 0, 1))[int(instance)].oriented_box
        corners = lines.points[8 * number : 8 * number + 8]
        assert np.allclose(corners, box.corners)
        ends = lines.extract_cells(np.flatnonzero(lines["og_instance"] == instance))
        lengths = np.sort(ends.compute_cell_sizes()["Length"])
        assert np.allclose(lengths, np.sort(np.repeat(box.size, 4)))
        color = mesh["og_color"][mesh["og_instance"] == instance][0]
        assert (lines["og_color"][lines["og_instance"] == instance] == color).all()
    assert pv.PolyData(scene.xyz + 50).og.boxes(scene).n_cells == 0


def test_ids_of_one_scene_are_not_read_as_those_of_another(bundle, tmp_path):
    cloud = room()
    ids = np.where(cloud.instance_ids >= 0, (cloud.instance_ids + 3) % len(cloud.instances), cloud.instance_ids)
    other = write_bundle(replace(cloud, instance_ids=ids), tmp_path / "other.ogpc")
    expected = pv.PolyData(og.load(other).xyz).og.select("plum", other)
    boxes = box_lines(og.instance_table(other))
    for mesh in (pv.read(bundle), pv.read(bundle).og.segment(["plum", "apple"])):
        ids = mesh["og_instance"].copy()
        assert np.array_equal(mesh.og.select("plum", other).points, expected.points)
        assert np.array_equal(mesh.og.boxes(other)["og_instance"], boxes["og_instance"]), "none is left out"
        assert np.array_equal(mesh.og.boxes(other)["og_color"], boxes["og_color"]), "the labels are another scene's"
        assert np.array_equal(mesh["og_instance"], ids)
    for mixed in (np.full(len(ids), len(cloud.instances)), ids + 0.5):  # of an earlier fit; averaged by a filter
        stale = pv.read(bundle)
        stale.point_data["og_instance"] = mixed
        assert np.array_equal(stale.og.boxes()["og_instance"], pv.read(bundle).og.boxes()["og_instance"])
    in_memory = og.LabelledScene.from_cloud(og.load(other).cloud)
    assert np.array_equal(pv.read(bundle).og.select("plum", in_memory).points, expected.points)


IN_WORLD = r"segmented with a pose; expected points in the scene's world .*mesh\.transform\(mesh"
POSE = np.array([[1.0, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_a_dataset_that_is_not_in_world_coordinates_gets_no_boxes_there(scene, bundle):
    mesh = pv.PolyData(scene.xyz - POSE[:3, 3]).og.segment(["plum"], bundle, pose=POSE)
    assert mesh.og.select("plum").n_points > 0, "by the ids that it has"
    for query in (mesh.og.boxes, partial(mesh.og.select, "plum", og.LabelledScene.from_cloud(scene.cloud))):
        with pytest.raises(og.OgPointcloudError, match=IN_WORLD):
            query()
    moved = mesh.transform(mesh.field_data["og_pose"], inplace=False).og.segment(["plum"], bundle)
    expected = pv.PolyData(scene.xyz).og.segment(["plum"], bundle).og.boxes()
    assert np.allclose(moved.og.boxes().points, expected.points)
    assert mesh.og.segment(["plum"], bundle, pose=POSE).n_points == mesh.n_points
    unmoved = pv.PolyData(scene.xyz).og.segment(["plum"], bundle, pose=np.eye(4))
    assert np.allclose(unmoved.og.boxes().points, expected.points)


def test_a_scene_is_read(bundle, tmp_path):
    mesh, scene = pv.read(bundle), og.load(bundle)
    assert np.array_equal(mesh.points, scene.xyz)
    assert np.array_equal(mesh["RGB"], scene.cloud.rgb)
    assert np.array_equal(mesh["og_instance"], scene.instance_ids)
    (tmp_path / "damaged.ogpc").write_bytes(b"PK nothing")
    with pytest.raises(og.BundleError):
        pv.read(tmp_path / "damaged.ogpc")


def colors_seen(plotter):
    image = np.asarray(plotter.screenshot(return_img=True))[..., :3]
    return {tuple(color) for color in np.unique(image.reshape(-1, 3), axis=0).tolist()}


def test_a_segmentation_is_drawn_in_its_colors_with_a_legend(plotter, scene):
    mesh = pv.PolyData(scene.xyz).og.segment(["apple", "pear", "plum"], scene)
    plotter.og.add_segmentation(mesh, names=False, legend=False)
    plotter.view_isometric()
    wanted = {tuple(color) for color in label_colors(np.unique(mesh["og_label"][mesh["og_label"] >= 0])).tolist()}
    assert wanted | {UNKNOWN_COLOR} <= colors_seen(plotter)
    assert plotter.renderer.legend is None
    plotter.og.add_segmentation(mesh)
    legend = plotter.renderer.legend
    counts = og.segment(scene, ["apple", "pear", "plum"]).counts()
    entries = [legend.GetEntryString(k) for k in range(legend.GetNumberOfEntries())]
    ordered = sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])
    assert entries == [*(f"{name}  {counts[name]:,}" for name in ordered), f"unknown  {(mesh['og_label'] < 0).sum():,}"]
    assert len([name for name in plotter.actors if name.startswith("og_segmentation")]) == 2, "drawn again, not twice"


@pytest.mark.parametrize("shown", ["legend", "names", "answer"])
def test_words_in_other_scripts_are_drawn(drawing, scene, shown):
    pictures = []
    for word in ("кот", "дом"):  # where VTK's own font is taken, both are blank
        words = {word: scene.cloud.instances.descriptors[0]}
        mesh = pv.PolyData(scene.xyz).og.segment(words, scene)
        plotter = pv.Plotter(off_screen=True, window_size=[400, 300])
        plotter.og.add_segmentation(mesh, names=shown == "names", legend=shown == "legend")
        if shown == "answer":
            plotter.og.enable_click_query(scene, words, show_message=False)
            assert plotter.og.query(scene.xyz[scene.instance_ids == 0][0]).found
        pictures.append(plotter.screenshot(return_img=True))
        plotter.close()
    assert (pictures[0] != pictures[1]).any()


def test_words_that_no_font_has_are_said(monkeypatch):
    font_manager = pytest.importorskip("matplotlib.font_manager")
    monkeypatch.setattr(font_manager.fontManager, "ttflist", [])
    with pytest.warns(UserWarning, match="no font of this machine has all of 子椅"):
        assert Path(font_file("a 椅子")).is_file()
    assert font_file("Tür, żółty") is None


def test_the_datasets_own_colors_shade_those_of_the_labels(plotter, scene):
    mesh = pv.PolyData(scene.xyz).og.segment(["plum"], scene)
    mesh["RGB"] = np.where(np.arange(mesh.n_points)[:, None] % 2, 255, 0).astype(np.uint8) * np.ones(3, np.uint8)
    plotter.og.add_segmentation(mesh, names=False, legend=False)
    plotter.view_isometric()
    full = label_colors(np.array([0]))[0]
    assert {tuple(full.tolist()), tuple((full * 0.5).astype(int).tolist())} <= colors_seen(plotter)


def test_what_cannot_be_drawn_is_said(plotter, scene):
    mesh = pv.PolyData(scene.xyz)
    with pytest.raises(og.OgPointcloudError, match="no point array 'og_label'"):
        plotter.og.add_segmentation(mesh)
    with pytest.raises(og.OgPointcloudError, match="no point array 'og_label'"):
        plotter.og.show_labelled(mesh)
    nameless = mesh.copy()
    nameless["og_label"] = scene.instance_ids
    with pytest.raises(og.OgPointcloudError, match=r"PolyData of 3,000 points has no field array 'og_names'"):
        plotter.og.add_segmentation(nameless)
    mixed = mesh.og.segment(["plum"], scene)
    for labels, shown in ((mixed["og_label"] + 0.5, r"float64 up to 0\.5"), (mixed["og_label"] + 1, "int32 up to 1")):
        mixed.point_data["og_label"] = labels
        with pytest.raises(og.OgPointcloudError, match=rf"'og_label' is {shown}; expected whole numbers below 1"):
            plotter.og.add_segmentation(mixed)
    with pytest.raises(og.OgPointcloudError, match="up is"):
        plotter.og.show_labelled(mesh.og.segment(["pear"], scene), up=(0, 0, 0))
    with pytest.raises(og.OgPointcloudError, match="expected 'label' or 'instance'"):
        plotter.og.add_segmentation(mesh, by="color")
    with pytest.raises(og.OgPointcloudError, match=r"0 points.*cannot be drawn"):
        plotter.og.add_segmentation(pv.PolyData())
    for thing in (pv.MultiBlock([mesh]), og.segment(scene, ["plum"]), scene.xyz):
        for draw in (plotter.og.add_segmentation, plotter.og.show_labelled):
            with pytest.raises(og.OgPointcloudError, match="cannot be drawn; expected a segmented dataset"):
                draw(thing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        unknown = pv.PolyData(scene.xyz + 50).og.segment(["plum"], scene)
    with pytest.warns(UserWarning, match="has a label: all are drawn gray"):
        plotter.og.add_segmentation(unknown)
    with pytest.warns(UserWarning, match="no instance with points to draw a box around"):
        assert plotter.og.add_boxes(unknown) is None
    holes = mesh.og.segment(["plum"], scene)
    holes.points[:7] = np.nan
    with pytest.warns(UserWarning, match="7 of 3,000 points contain NaN"):
        plotter.og.add_segmentation(holes, names=False, legend=False)
    plotter.view_isometric()
    assert tuple(label_colors(np.array([0]))[0].tolist()) in colors_seen(plotter)


def test_boxes_of_a_scene_and_of_a_dataset(plotter, scene):
    mesh = pv.PolyData(scene.xyz).og.segment(["plum"], scene)
    of_mesh, of_scene = plotter.og.add_boxes(mesh), plotter.og.add_boxes(scene, name="all")
    assert of_mesh.mapper.dataset.n_cells < of_scene.mapper.dataset.n_cells == 12 * len(scene.instances)


def click_on(plotter, point):
    plotter.renderer.SetWorldPoint(*point, 1)
    plotter.renderer.WorldToDisplay()
    plotter.iren._mouse_left_button_click(*np.rint(plotter.renderer.GetDisplayPoint()[:2]).astype(int).tolist())


def test_a_click_shows_the_instance_and_its_words(plotter, scene):
    hits = []
    plotter.og.add_segmentation(pv.PolyData(scene.xyz).og.segment(["plum", "apple"], scene), legend=False, names=False)
    plotter.og.enable_click_query(scene, callback=hits.append, words=2)
    plotter.view_isometric()
    plotter.show(auto_close=False)
    magenta = tuple(pv.Color(HIGHLIGHT).int_rgb)
    assert magenta not in colors_seen(plotter)
    wanted = scene.instances[7]
    toward_eye = np.asarray(plotter.camera.position) - np.asarray(plotter.camera.focal_point)
    click_on(plotter, wanted.xyz[(wanted.xyz @ toward_eye).argmax()])
    assert [hit.instance for hit in hits] == [7]
    assert magenta in colors_seen(plotter)
    assert plotter.actors["og_highlight"].mapper.dataset.n_points == wanted.points
    answer = plotter.actors["og_answer"].GetText(0)
    words = og.pick(scene, wanted.xyz[0]).words()[:2]
    assert answer.split("\n") == [str(hits[0]), *(f"{score:5.2f}  {word}" for word, score in words)]
    background = scene.xyz[np.flatnonzero(scene.instance_ids == og.BACKGROUND)[0]]
    assert not plotter.og.query(background).found
    assert plotter.actors["og_answer"].GetText(0).startswith("background")
    assert magenta not in colors_seen(plotter)


def test_a_click_asks_the_scene_drawn_last(plotter, bundle):
    with pytest.raises(og.OgPointcloudError, match="no scene to query"):
        plotter.og.enable_click_query()
    with pytest.raises(og.OgPointcloudError, match=r"call plotter\.og\.enable_click_query"):
        plotter.og.query((0, 0, 0))
    mesh = pv.read(bundle).og.segment(["plum"])
    plotter.og.add_segmentation(mesh)
    plotter.og.enable_click_query()
    row = int(np.argmax(mesh["og_instance"] >= 0))
    assert plotter.og.query(mesh.points[row]).instance == mesh["og_instance"][row]


def test_clicks_on_a_dataset_that_is_not_in_world_coordinates_are_refused(plotter, scene, bundle):
    plotter.og.add_segmentation(pv.PolyData(scene.xyz - POSE[:3, 3]).og.segment(["plum"], bundle, pose=POSE))
    with pytest.raises(og.OgPointcloudError, match=IN_WORLD):
        plotter.og.enable_click_query()


def test_a_scene_without_words_still_answers_clicks(plotter, tmp_path):
    bare = write_bundle(replace(room(), vocabulary=None), tmp_path / "bare.ogpc")
    plotter.og.enable_click_query(bare)
    row = int(np.argmax(og.load(bare).instance_ids >= 0))
    plotter.og.query(og.load(bare).xyz[row])
    assert "no words of its own: pass labels" in plotter.actors["og_answer"].GetText(0)


def balls(folder):
    """Three balls of one instance each, on background: what the examples are run on."""
    random = np.random.default_rng(0)
    middle = np.repeat([[0, 0, 0.5], [2, 0, 0.5], [1, 1.6, 0.5]], 800, axis=0)
    surface = random.normal(size=middle.shape)
    floor = np.c_[random.random((1500, 2)) * [4, 3.6] - 1, np.zeros(1500)]
    xyz = np.concatenate([middle + 0.5 * surface / np.linalg.norm(surface, axis=1, keepdims=True), floor])
    cloud = make_cloud(xyz, np.append(np.repeat([0, 1, 2], 800), [-1] * 1500))
    certainty = np.clip(80 + 170 * xyz[:, 2], 0, 255).astype(np.uint8)  # sure above, less so near the floor
    return write_bundle(replace(cloud, certainty=certainty), folder / "balls.ogpc")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "files"),
    [
        ("01_label_a_cloud.py", ["labels.png", "labels.vtp"]),
        ("02_instances_and_boxes.py", ["instances.csv", "instances.png"]),
        ("03_click_query.py", ["after.png", "before.png"]),
        ("09_how_sure.py", ["how_sure.png"]),
    ],
)
def test_examples_leave_their_pictures(drawing, tmp_path, monkeypatch, capsys, example, files):
    assert len((EXAMPLES / example).read_text().splitlines()) < 60
    monkeypatch.setattr(sys, "argv", [example, str(balls(tmp_path)), "-o", str(tmp_path / "out")])
    runpy.run_path(str(EXAMPLES / example), run_name="__main__")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == files
    pictures = [np.asarray(pv.read(tmp_path / "out" / name).active_scalars) for name in files if name.endswith(".png")]
    for picture in pictures:
        assert len(np.unique(picture.reshape(len(picture), -1), axis=0)) > 3, "not a blank picture"
    if example.startswith("09"):
        shares = [float(line.split()[-1].rstrip("%")) for line in capsys.readouterr().out.splitlines()[1:-1]]
        assert len(shares) == 3
        assert all(60 < share < 95 for share in shares), "of a ball what lies above 0.28 is sure, seven tenths of it"
    if example.startswith("03"):
        assert "instance" in capsys.readouterr().out
        assert (pictures[0] == pv.Color(HIGHLIGHT).int_rgb).all(axis=-1).sum() > 500
        assert not (pictures[1] == pv.Color(HIGHLIGHT).int_rgb).all(axis=-1).any()
