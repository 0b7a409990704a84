"""`og-pointcloud view` of a scene: what the page holds, and what is refused."""

import base64
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace

import numpy as np
import pytest
from commands import error_of, output_of, run
from labelled_clouds import make_cloud, room
from og_pointcloud_export import write_bundle
from scenes import write_ply

import og_pointcloud as og
from og_pointcloud.cloud import Vocabulary
from og_pointcloud.show.page import TEMPLATE, Look, write_page
from og_pointcloud.show.viewpoint import FOCAL, Viewpoint, choose_viewpoint

Z_UP = np.array([0.0, 0, 1])


def content(page):
    """What is shown: the JSON in a page, with its arrays unpacked."""
    text = page.read_text(encoding="utf-8")
    data = json.loads(re.search(r'<script id="scene" type="application/json">(.*?)</script>', text, re.DOTALL)[1])
    for name, kind in (("place", "<u2"), ("rgb", "u1"), ("instance", "<i4"), ("word_scores", "<u2")):
        if data[name]:
            data[name] = np.frombuffer(zlib.decompress(base64.b64decode(data[name])), kind)
    return data


def test_a_stray_at_the_origin_of_the_map_moves_no_point_of_the_page(tmp_path, capsys):
    """It made each step of a place 80 m long: all points of a room fell into one."""
    cloud = room()
    xyz = np.vstack([cloud.xyz, np.float32([[-4e5, -5.4e6, -300]])])
    strayed = {"xyz": xyz, "origin": np.array([4e5, 5.4e6, 300]), "instance_ids": np.append(cloud.instance_ids, -1)}
    write_bundle(replace(cloud, **strayed, rgb=None, certainty=None), tmp_path / "a.ogpc")
    assert "left out of the page: 1 of" in output_of(capsys, "view", tmp_path / "a.ogpc", "--instances", "--cut", "0.5")
    data = content(tmp_path / "a.html")
    place = data["place"].reshape(-1, 3) / 65535 * data["size"] + data["low"]
    assert np.allclose(np.ptp(place, axis=0), np.ptp(cloud.xyz, axis=0), atol=1e-3)


def test_the_page_holds_what_segment_answers(bundle, tmp_path, capsys):
    page = tmp_path / "new folder" / "room.html"
    stdout = output_of(capsys, "view", bundle, "--labels", "plum,apple", "--html", page, "--boxes", "--cut", "0.25")
    assert f"wrote {page}" in stdout
    scene, data = og.load(bundle), content(page)
    result = og.segment(scene, ["plum", "apple"])
    assert data["names"] == ["plum", "apple"]
    assert dict(zip(data["names"], data["counts"], strict=True)) == result.counts()
    assert (data["boxes"], data["cut"], data["mode"], data["meaning"][:6]) == (True, 0.25, "labels", "cosine")
    place = data["place"].reshape(-1, 3) / 65535 * data["size"] + data["low"]
    middle = (scene.xyz.min(axis=0) + scene.xyz.max(axis=0)) / 2
    assert np.abs(place + middle - scene.xyz).max() <= np.ptp(scene.xyz, axis=0).max() / 131000
    assert np.array_equal(data["instance"], result.instances)
    assert np.array_equal(data["rgb"].reshape(-1, 3), scene.cloud.rgb)
    label = np.append([row["label"] for row in data["instances"]], [-1, -1, -1])
    assert np.array_equal(label[data["instance"]], result.labels)
    table = og.instance_table(scene, up=Z_UP, words=6)
    for row, shown in zip(table, data["instances"], strict=True):
        assert [tuple(word) for word in shown["words"]] == list(row.words)
        assert np.allclose(np.array(shown["box"]) + middle, row.oriented_box.corners)
    scores = scene.chooser.choose(scene.vocabulary.vectors).scores
    stored = data["lowest"] + data["word_scores"].reshape(scores.shape) / 65535 * (data["highest"] - data["lowest"])
    known = np.isfinite(scores)
    assert np.abs(stored - scores)[known].max() < 1e-4
    from_elsewhere = r"https?:|src=|href=|import\(|fetch\(|@import|url\("
    assert not re.search(from_elsewhere, page.read_text(encoding="utf-8"))


def test_without_a_name_the_page_lies_beside_the_scene(bundle, tmp_path, capsys):
    scene = tmp_path / "room.ogpc"
    scene.write_bytes(bundle.read_bytes())
    stdout = output_of(capsys, "view", scene, "--up", "0,-2,0")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["room.html", "room.ogpc"]
    assert f"wrote {tmp_path / 'room.html'}" in stdout
    assert content(tmp_path / "room.html")["up"] == [0, -1, 0]


def test_what_is_gone_is_no_instance_of_a_page(tmp_path):
    cloud = room(300)
    kept = cloud.instance_ids != 0
    points = np.where(np.arange(len(cloud.instances)) == 0, 0, cloud.instances.points).astype(np.int32)
    cloud = replace(
        cloud, xyz=cloud.xyz[kept], instance_ids=cloud.instance_ids[kept], rgb=None, certainty=None,
        instances=replace(cloud.instances, points=points),
    )  # fmt: skip
    scene = og.LabelledScene.from_cloud(cloud)
    write_page(tmp_path / "p.html", scene, og.segment(scene), Viewpoint(np.ones(3), np.zeros(3), Z_UP), Look("room"))
    assert content(tmp_path / "p.html")["subtitle"].endswith(f" {len(cloud.instances) - 1} instances")


def test_places_far_from_the_origin_are_told_to_a_tenth(tmp_path, capsys):
    far = og.write_bundle(replace(room(300), origin=np.array([4000123.25, -500000.5, 30])), tmp_path / "far.ogpc")
    output_of(capsys, "view", far, "--html", tmp_path / "far.html")
    rows = content(tmp_path / "far.html")["instances"]
    places = [row.centroid for row in og.load(far).instances]
    assert [row["world"] for row in rows] == [f"{x:.1f}, {y:.1f}, {z:.4g}" for x, y, z in places]
    assert "origin (4000123.25, -500000.5, 30)" in output_of(capsys, "info", far)


def test_why_an_instance_has_no_words_is_said(tmp_path):
    cloud, page, view = room(300), tmp_path / "page.html", Viewpoint(np.ones(3), np.zeros(3), Z_UP)
    for known, note in ((cloud, "cosine: how similar"), (replace(cloud, vocabulary=None), "the scene stores no words")):
        scene = og.LabelledScene.from_cloud(known)
        labels = {"nothing": -cloud.instances.descriptors.sum(axis=0)}
        write_page(page, scene, og.segment(scene, labels), view, Look("room"))
        notes = [row["note"] for row in content(page)["instances"]]
        assert notes[4].startswith("no mask gave it a feature"), "it has no descriptor"
        assert all(each.startswith(note) for each in notes[:4] + notes[5:])
    assert page.read_text(encoding="utf-8").count("row.note") == 1


def in_node(script):
    """The lines that a script, given as lines, prints."""
    if (node := shutil.which("node")) is None:
        pytest.skip("no node here to run the page's script")
    done = subprocess.run([node, "-e", "\n".join(script)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_up_button_starts_at_the_axis_nearest_to_up(bundle, tmp_path):
    scene = og.load(bundle)
    view = Viewpoint(np.ones(3), np.zeros(3), np.array([0.02, -0.1, 0.99]))
    write_page(tmp_path / "page.html", scene, og.segment(scene), view, Look("room"))
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if re.search(r'const (steepest|axis) = |\$\("up"\)\.onclick', line)]
    up = content(tmp_path / "page.html")["up"]
    prelude = f"let up = {up}; const button = {{}}, $ = () => button, draw = () => {{}}"
    script = [prelude, *sorted(lines, key=lambda line: "onclick" in line), "axis(); console.log(button.textContent)"]
    script += ["button.onclick(); console.log(button.textContent, String(up))"] * 2
    assert in_node(script) == ["up: z", "up: -z 0,0,-1", "up: x 1,0,0"]


def test_names_cannot_break_out_of_the_page(tmp_path):
    name = "</script><script>alert(1)</script><!--"
    cloud = room(300)
    cloud = replace(cloud, vocabulary=Vocabulary((name, *cloud.vocabulary.names[1:]), cloud.vocabulary.vectors))
    scene = og.LabelledScene.from_cloud(cloud)
    page = tmp_path / "page.html"
    result = og.segment(scene)
    write_page(page, scene, result, Viewpoint(np.ones(3), np.zeros(3), Z_UP), Look(name))
    assert "alert(1)</script>" not in page.read_text(encoding="utf-8")
    assert content(page)["names"][0] == content(page)["title"] == name


def test_other_points_by_instance_with_rows_that_are_no_number(bundle, tmp_path, capsys):
    scene = og.load(bundle)
    xyz = np.concatenate([scene.xyz[::2], [[9, 9, 9]]]).astype(np.float32)
    write_ply(tmp_path / "other.ply", xyz, np.tile(np.arange(len(xyz))[:, None] % 256, 3).astype(np.uint8))
    page = tmp_path / "other.html"
    assert run(capsys, "view", bundle, "--cloud", tmp_path / "other.ply", "--html", page, "--instances")[0] == 0
    data = content(page)
    assert (data["title"], data["mode"], data["points"]) == ("other", "instances", len(xyz))
    assert np.array_equal(data["instance"], og.segment(xyz, None, scene).instances)
    assert np.array_equal(data["rgb"].reshape(-1, 3)[:, 0], np.arange(len(xyz)) % 256)
    result = og.segment(np.concatenate([scene.xyz[:9], [[np.nan] * 3]]), None, scene)
    left_out = write_page(page, scene, result, Viewpoint(np.ones(3), np.zeros(3), Z_UP), Look(""))
    assert left_out == "1 of 10 points"
    assert content(page)["points"] == 9


def test_nothing_found_is_said(bundle, tmp_path, capsys):
    write_ply(tmp_path / "far.ply", np.full((5, 3), 50, np.float32), np.zeros((5, 3), np.uint8))
    code, _, stderr = run(capsys, "view", bundle, "--cloud", tmp_path / "far.ply", "--html", tmp_path / "far.html")
    assert code == 0
    assert "none of 5 points has a label: 5 are too far from the scene" in stderr
    empty = write_bundle(make_cloud(np.zeros((0, 3)), []), tmp_path / "empty.ogpc")
    assert "has no points to show" in error_of(capsys, "view", empty, "--html", tmp_path / "empty.html")
    assert not (tmp_path / "empty.html").exists()


def called(prelude, function, call):
    """What a function of the page prints in node, with its surroundings replaced by a prelude."""
    text = TEMPLATE.read_text(encoding="utf-8")
    constants = [line for line in text.splitlines() if line.startswith(("const VISIBLE", "const css"))]
    own = re.search(rf"^function {function}\(.*?^\}}", text, re.DOTALL | re.MULTILINE)[0]
    return in_node([prelude, *constants, own, call])


def test_a_link_to_an_instance_that_the_page_lacks_shows_no_card():
    prelude = """
        const row = { points: 1, views: 1, words: [], label: -1, note: "" }, OFFSET = 3
        const scene = { instances: [row], reasons: ["too far", "unobserved", "background"], unlabelled: "unknown" }
        const add = (parent, tag, text) => (console.log(text), { style: {} })
        const select = (ids, fill) => fill ? fill() : console.log("no card")"""
    shown = called(prelude, "askInstance", "for (const id of [-4, 1, NaN, -1, 0]) askInstance(id)")
    assert shown[:3] == ["no card"] * 3
    assert shown[3:] == ["background", "no instance", "unknown", "instance 0 · 1 point · 1 view", ""]


def test_a_name_as_long_as_a_sentence_does_not_cover_the_things():
    prelude = """
        const row = { points: 1, words: [], label: 0, center: [0, 0, 0] }, scene = { names: ["a".repeat(300)] }
        const drawn = (text) => console.log(text)
        const pen = new Proxy({}, { get: (_, name) => name === "fillText" ? drawn : () => ({ width: 9 }) })
        const overlay = { getContext: () => pen }, innerWidth = 9, innerHeight = 9, devicePixelRatio = 1
        const $ = (id) => ({ checked: id === "names" }), state = {}, colorOf = () => [0, 0, 0]
        const shownInstances = () => [row], project = () => ({ x: 1, y: 1, depth: 1 })"""
    assert called(prelude, "write", "write()") == ["a" * 40 + "…"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--html", "x.html", "--cut", "1"], "--cut is 1.0; expected a share"),
        (["--html", "x.html", "--labels", "appel"], "did you mean 'apple'"),
        (["--html", "x.html", "--up", "0,0,0"], "--up is '0,0,0'; expected x, y, z, -x, -y, -z or a direction"),
    ],
)
def test_bad_use_is_refused_in_one_line(bundle, tmp_path, capsys, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    assert said in error_of(capsys, "view", bundle, *options)
    assert list(tmp_path.iterdir()) == []


def test_instances_are_shown_without_any_words(bundle, tmp_path, capsys):
    wordless = write_bundle(replace(og.load(bundle).cloud, vocabulary=None), tmp_path / "wordless.ogpc")
    code, stdout, stderr = run(capsys, "view", wordless, "--instances")
    assert (code, stderr) == (0, "")
    assert "unknown" not in stdout
    assert re.search(r"^\d+\.\d% of [\d,]+ points in \d+ instances$", stdout, re.MULTILINE)
    data = content(tmp_path / "wordless.html")
    assert (data["mode"], data["names"]) == ("instances", [])
    assert np.array_equal(data["instance"], og.load(bundle).instance_ids)
    assert "the scene has no words" in run(capsys, "view", wordless)[2]


def test_the_view_is_from_where_labelled_points_are_in_sight():
    random = np.random.default_rng(0)
    wall = np.c_[np.full(4000, 0.0), random.random((4000, 2)) * [4, 3] - [2, 0]]
    thing = np.array([0.4, 0, 0.4]) + 0.2 * random.random((400, 3))
    for side in (1, -1):
        xyz = np.concatenate([wall, thing]) * [side, 1, 1]
        view = choose_viewpoint(xyz, np.arange(len(xyz)) >= len(wall), Z_UP)
        assert side * (view.eye - view.target)[0] > 0, "the wall would hide it"
        assert (view.eye - view.target)[2] > 0
        back = (view.eye - view.target) / np.linalg.norm(view.eye - view.target)
        right = np.cross(Z_UP, back) / np.linalg.norm(np.cross(Z_UP, back))
        x, y, depth = np.stack([right, np.cross(back, right), -back]) @ (xyz - view.eye).T
        assert np.mean((np.abs(FOCAL * y / depth) < 1) & (np.abs(FOCAL * x / depth) < 1.6)) > 0.97
        assert np.abs(FOCAL * y / depth).max() > 0.7, "it fills the picture"


@pytest.mark.parametrize("xyz", [[[1, 1, 1]], [[0, 0, 0], [1, 1, 1]], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]])
def test_a_handful_of_points_is_in_the_picture(xyz):
    xyz = np.array(xyz, np.float64)
    view = choose_viewpoint(xyz, np.zeros(len(xyz), bool), Z_UP)
    uv_px, _ = view.camera(320, 200, FOCAL * 100).project(xyz)
    assert ((uv_px >= 0) & (uv_px <= [320, 200])).all()


@pytest.mark.slow
def test_a_browser_opens_the_page_and_answers(bundle, tmp_path, capsys):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here")
    page = tmp_path / "room.html"
    run(capsys, "view", bundle, "--labels", "plum,apple", "--html", page)
    command = [
        browser, "--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-sync",
        "--disable-component-update", f"--user-data-dir={tmp_path / 'profile'}", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--window-size=500,400", "--virtual-time-budget=5000", "--dump-dom",
    ]  # fmt: skip
    done = subprocess.run([*command, f"file://{page}#instance=3"], capture_output=True, text=True, timeout=100)
    dom = done.stdout.split("<script id=")[0] + done.stdout.split("</script>")[-1]
    if "has no WebGL 2" in dom.split("<canvas")[-1]:
        pytest.skip("this Chromium has no WebGL 2")
    assert 'data-ready="yes"' in done.stdout, done.stderr[-500:]
    counts = og.segment(bundle, ["plum", "apple"]).counts()
    for name, count in counts.items():
        assert re.search(rf"<span[^>]*>{name}</span><small class=\"number\">{count:,}</small>", dom)
    words = og.load(bundle).instances[3].words
    assert re.search(rf"instance 3 · .*?<span[^>]*>{words[0][0]}</span><span class=\"number\">{words[0][1]:.2f}", dom)
