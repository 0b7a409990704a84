"""The published training: its losses against literal loops, and what its stages must do."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import itertools
import operator
import runpy
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from reference_splatting import reference_pixel_weights
from scenes import TinyCapture

from og_pointcloud.errors import OgPointcloudError, SceneError
from og_pointcloud.fitting.fit import prepare
from og_pointcloud.fitting.work_folder import WorkFolder
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.journal import Journal
from og_pointcloud.rendering.splatting import Gaussians, view_weights
from og_pointcloud.rendering.surface import stride_for_pixels
from og_pointcloud.scene import Camera, View
from og_pointcloud.settings import PaperSettings

torch = pytest.importorskip("torch")
paper = pytest.importorskip("og_pointcloud.fitting.learned.paper")
rendered_views = pytest.importorskip("og_pointcloud.fitting.learned.rendered_views")

NEAR = 0.05
SHORT = PaperSettings(schedule_share=0.005, covered_share=0.3, feature_rate=2e-2, coarse_rate=1e-3, k1=8, k2=3)
PAGE = Path(__file__).parents[1] / "docs" / "paper.md"


@dataclass(frozen=True)
class Balls:
    gaussians: Gaussians
    views: Sequence[View]
    object_ids: NDArray[np.int32]


@pytest.fixture
def balls(tiny_capture: TinyCapture) -> Balls:
    scene = read_capture(tiny_capture.folder)
    surface = prepare(scene).surface
    return Balls(surface.gaussians.take(surface.row_of_point), scene.views, tiny_capture.object_ids)


def train_features(gaussians: Gaussians, views: Sequence[View], settings: PaperSettings, run: Any = None) -> Any:
    source = rendered_views.RenderedViews(gaussians, views, NEAR, settings, whole=False)
    return paper.train_features(source, settings, run)


def train_codebook(
    gaussians: Gaussians, views: Sequence[View], raw: NDArray[np.float32], settings: PaperSettings, run: Any = None
) -> Any:
    source = rendered_views.RenderedViews(gaussians, views, NEAR, settings, whole=settings.formula == "paper")
    return paper.train_codebook(source, raw, settings, run)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_printed_losses_are_those_of_dense_pixels(balls: Balls, dtype: torch.dtype) -> None:
    """Value and gradient of Eq. 1 and 2 over all views, every pixel of a mask counted, pair by pair."""
    settings = PaperSettings(formula="paper", covered_share=0)
    values = np.random.default_rng(0).random((len(balls.gaussians), 6), np.float32)
    source = rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, settings, whole=False)
    features = torch.tensor(values, dtype=dtype, requires_grad=True)
    loss = torch.zeros((), dtype=dtype)
    for view in source:
        image = view.render(features[source.known])
        separation, cohesion = paper.view_losses(image, view.mask, settings)
        loss = loss + (separation + 10 * cohesion / source.masked_pixels) / len(source)
    loss.backward()

    literal = torch.tensor(values, dtype=torch.float64, requires_grad=True)
    expected, masked = torch.zeros((), dtype=torch.float64), 0
    for view in balls.views:
        weights = view_weights(balls.gaussians, view.camera, NEAR).toarray().astype(np.float64)
        image, ids = torch.tensor(weights) @ literal, view.mask_map().ravel()
        members = [np.flatnonzero(ids == mask) for mask in range(view.mask_count)]
        means = [image[pixels].mean(dim=0) for pixels in members if len(pixels)]
        for mean, pixels in zip(means, filter(len, members), strict=True):
            expected = expected + 10 * (image[pixels] - mean).square().sum() / source.masked_pixels
        for i, j in itertools.permutations(range(len(means)), 2):
            square = (means[i] - means[j]).square().sum() + paper.SMALLEST_DISTANCE**2
            expected = expected + 1 / square / (len(means) * (len(means) - 1))
        masked += int((ids >= 0).sum())
    (expected / len(balls.views)).backward()
    assert source.masked_pixels == pytest.approx(masked / len(balls.views))
    tolerance = 1e-6 if dtype == torch.float64 else 1e-4
    assert loss.item() == pytest.approx(expected.item() / len(balls.views), rel=tolerance)
    largest = float(literal.grad.abs().max())
    np.testing.assert_allclose(features.grad.numpy(), literal.grad.numpy(), rtol=0, atol=tolerance * largest)


def test_blend_has_the_gradient_of_a_dense_product(balls: Balls) -> None:
    view = rendered_views.RenderedViews(balls.gaussians, balls.views[:1], NEAR, SHORT, whole=False)[0]
    values = torch.rand((view.weights.shape[1], 2), dtype=torch.float64, requires_grad=True)
    pull = torch.rand((len(view.mask), 2), dtype=torch.float64)
    dense = torch.tensor(view.weights.toarray(), dtype=torch.float64)
    image = view.render(values)
    torch.testing.assert_close(image, dense @ values)
    (gradient,) = torch.autograd.grad(image, values, pull)
    torch.testing.assert_close(gradient, dense.T @ pull)


def test_a_training_draws_no_clusters_of_the_one_before(balls: Balls) -> None:
    """The same views, drawn for two trainings in turn: the second is as if they were drawn for it alone."""
    settings = replace(SHORT, fine_alone=True)
    raw = np.random.default_rng(0).random((len(balls.gaussians), 6), np.float32)

    def drawn() -> rendered_views.RenderedViews:
        return rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, settings, whole=False)

    used = drawn()
    paper.train_codebook(used, raw, settings)
    assert any(cluster >= 0 for _, _, cluster in used._kept)
    run = paper.TrainingRun(seed=1)
    again, alone = (paper.train_codebook(source, raw, settings, run) for source in (used, drawn()))
    np.testing.assert_array_equal(again.leaf, alone.leaf)
    np.testing.assert_array_equal(again.centers, alone.centers)


def test_all_tensors_lie_on_the_device_that_the_settings_name(balls: Balls) -> None:
    """What is made without naming a device goes to another one here, where nothing can be computed with it."""
    settings = replace(SHORT, device="cpu", fine_alone=True)
    source = rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, settings, whole=False)
    features = paper.train_features(source, settings)
    book = paper.train_codebook(source, features.raw, settings)
    with torch.device("meta"):
        source = rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, settings, whole=False)
        again = paper.train_features(source, settings)
        same = paper.train_codebook(source, again.raw, settings)
    np.testing.assert_array_equal(again.raw, features.raw)
    np.testing.assert_array_equal(same.leaf, book.leaf)


@pytest.mark.parametrize("name", ["cuda" if not torch.cuda.is_available() else "cuda:99", "meta", "the sun"])
def test_a_device_that_is_not_there_is_refused(balls: Balls, name: str) -> None:
    with pytest.raises(OgPointcloudError, match=f"device is '{name}', .* expected one of cpu, auto"):
        rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, replace(SHORT, device=name), whole=False)
    assert rendered_views.device_of("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")


def test_reading_has_the_gradient_of_plain_operations() -> None:
    zero = torch.zeros((2, 6), dtype=torch.float64, requires_grad=True)
    assert (paper._read(zero, normalize=True) == 0.5).all()
    paper._read(zero, normalize=True).sum().backward()
    assert (zero.grad == 0).all()
    raw = torch.rand((50, 6), dtype=torch.float64, requires_grad=True)
    pull = torch.rand((50, 6), dtype=torch.float64)
    plain = 0.5 + 0.5 * torch.nn.functional.normalize(raw, dim=1)
    read = paper._read(raw, normalize=True)
    torch.testing.assert_close(read, plain)
    torch.testing.assert_close(torch.autograd.grad(read, raw, pull), torch.autograd.grad(plain, raw, pull))
    assert paper._read(raw, normalize=False) is raw


@pytest.mark.parametrize("late", [False, True])
def test_losses_of_the_authors_pixel_by_pixel(late: bool) -> None:
    rng = np.random.default_rng(0)
    image, mask = rng.random((200, 6)), rng.integers(0, 12, 200)
    separation, cohesion = paper.view_losses(torch.tensor(image), torch.tensor(mask), PaperSettings(), late=late)
    means = np.array([image[mask == i].mean(axis=0) for i in range(12)])
    spread = np.mean([np.linalg.norm(image[mask == i] - means[i], axis=1).mean() for i in range(12)])
    assert cohesion.item() == pytest.approx(spread, rel=1e-5)
    total = 0.0
    for i in range(12):
        near = sorted(1 / (((means[i] - means[j]) ** 2).sum() + 1) for j in range(12) if j != i)
        weights = [0.1 + 0.9 * rank / 11 for rank in range(1, 12)]
        total += sum(value * (0.1 if late and w < 0.9 else w) for value, w in zip(near, weights, strict=True))
    assert separation.item() == pytest.approx(total / (12 * 11), rel=1e-12)


def test_equal_means_give_finite_losses_and_gradients() -> None:
    image = torch.full((20, 6), 0.3, requires_grad=True)
    mask = torch.arange(20) % 4
    for formula in ("paper", "authors"):
        separation, cohesion = paper.view_losses(image, mask, PaperSettings(formula=formula))
        (gradient,) = torch.autograd.grad(separation + cohesion, image)
        assert np.isfinite([separation.item(), cohesion.item()]).all()
        assert torch.isfinite(gradient).all()


AS_PRINTED = replace(SHORT, formula="paper", normalize=False, cohesion_weight=3e3, feature_rate=4e-2)
OF_AUTHORS = replace(SHORT, cluster_raw=True, fine_alone=True)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(SHORT, id="ours"),
        pytest.param(AS_PRINTED, id="paper", marks=pytest.mark.slow),
        pytest.param(OF_AUTHORS, id="authors", marks=pytest.mark.slow),
    ],
)
def test_both_stages_part_the_balls(balls: Balls, settings: PaperSettings) -> None:
    trained = train_features(balls.gaussians, balls.views, settings)
    seen = trained.seen > 5
    assert np.isfinite(trained.features).all()
    red, blue = (trained.features[seen & (balls.object_ids == ball)] for ball in (0, 1))
    between = np.linalg.norm(red.mean(axis=0) - blue.mean(axis=0))
    assert between > 3 * max(np.linalg.norm(ball - ball.mean(axis=0), axis=1).mean() for ball in (red, blue))

    book = train_codebook(balls.gaussians, balls.views, trained.raw, settings)
    np.testing.assert_array_equal(book.leaf >= 0, trained.seen > 0)
    assert book.centers.shape == (24, 6)
    sure = seen & (balls.object_ids >= 0)
    members = np.zeros((24, 2))
    np.add.at(members, (book.leaf[sure], balls.object_ids[sure]), 1)
    assert members.max(axis=1).sum() > 0.9 * sure.sum()
    for leaf in np.unique(book.leaf[book.leaf >= 0]):  # centers are where their features are
        assert np.abs(book.centers[leaf] - np.median(trained.features[book.leaf == leaf], axis=0)).max() < 0.5
    assert [stage.steps for stage in (trained.history, *book.histories)] == [100, 100, 100]
    assert [stage.published_steps for stage in (trained.history, *book.histories)] == [20_000] * 3
    assert np.mean(trained.history.loss[-20:]) < np.mean(trained.history.loss[:20])


def test_training_is_repeatable_and_does_not_depend_on_what_is_kept(balls: Balls) -> None:
    settings = replace(SHORT, schedule_share=0.001)
    first = train_features(balls.gaussians, balls.views, settings, paper.TrainingRun(seed=2))
    uncached = train_features(balls.gaussians, balls.views, replace(settings, cache_bytes=0), paper.TrainingRun(seed=2))
    np.testing.assert_array_equal(first.features, uncached.features)
    other = train_features(balls.gaussians, balls.views, settings, paper.TrainingRun(seed=3))
    assert np.abs(other.features - first.features).max() > 0.1
    books = [
        train_codebook(balls.gaussians, balls.views, first.raw, each, paper.TrainingRun(seed=2))
        for each in (settings, replace(settings, cache_bytes=0))
    ]
    np.testing.assert_array_equal(books[0].leaf, books[1].leaf)
    np.testing.assert_array_equal(books[0].centers, books[1].centers)


def test_gaussians_that_no_mask_shows_get_neither_feature_nor_cluster(balls: Balls) -> None:
    hidden = replace(balls.gaussians, xyz=balls.gaussians.xyz.copy())
    hidden.xyz[:10] = [0, 0, -50]
    settings = replace(SHORT, schedule_share=0.0005)
    trained = train_features(hidden, balls.views, settings)
    book = train_codebook(hidden, balls.views, trained.raw, settings)
    assert (trained.seen[:10] == 0).all()
    assert (trained.features[:10] == 0).all()
    assert (book.leaf[:10] == -1).all()
    assert (book.leaf[trained.seen > 0] >= 0).all()


def test_fine_clusters_are_at_most_the_masks_held_and_one(balls: Balls) -> None:
    """Two balls, one coarse cluster: two masks a view, so three leaves of the five allowed."""
    settings = replace(SHORT, schedule_share=0.0005, k1=1, k2=5)
    features = np.random.default_rng(0).random((len(balls.gaussians), 6), np.float32)
    book = train_codebook(balls.gaussians, balls.views, features, settings)
    assert len(np.unique(book.leaf[book.leaf >= 0])) == 3
    fixed = train_codebook(balls.gaussians, balls.views, features, replace(settings, formula="paper"))
    assert len(np.unique(fixed.leaf[fixed.leaf >= 0])) == 5


def test_a_codebook_step_moves_features_by_the_gradient_of_their_centers(balls: Balls) -> None:
    """Straight through: Adam's first step is the rate against the sign of W' sign(W c - W f), c the centers' rows."""
    settings = replace(SHORT, formula="paper", normalize=False, k1=4, schedule_share=1 / 20_000)
    features = np.random.default_rng(0).random((len(balls.gaussians), 6), np.float32)
    source = rendered_views.RenderedViews(balls.gaussians, balls.views[:1], NEAR, settings, whole=True)
    features = features[source.known]
    training = paper._CodebookTraining(source, torch.from_numpy(features.copy()), settings)
    history = paper.StageHistory("coarse codebook", 20_000)
    parts = paper._Parts([np.arange(len(features))], [4], np.zeros((len(features), 0), np.float32))
    start = features[:4]
    own, centers = paper.kmeans(features, np.ones(len(features)), start, settings.lloyd_rounds)
    training.train(history, start, parts, paper.TrainingRun(), "")

    weights, quantised = source[0].weights.astype(np.float64), centers[own].astype(np.float64)
    image = weights @ quantised - weights @ features.astype(np.float64)
    gradient = weights.T @ np.sign(image)
    clear = np.abs(gradient) > 1e-3
    moved = training.features.numpy() - features
    np.testing.assert_allclose(moved[clear], -settings.coarse_rate * np.sign(gradient)[clear], atol=1e-7)
    assert history.loss[0] == pytest.approx(np.abs(image).mean(), rel=1e-5)
    assert clear.mean() > 0.8


def test_gaussians_shrunk_to_nothing_leave_the_view_as_it_is(balls: Balls, monkeypatch: pytest.MonkeyPatch) -> None:
    class Never:
        """Draws view 0, then "shrink", then "to nothing"."""

        def integers(self, _: int) -> int:
            return 0

        def random(self) -> float:
            return 0.0

    # Half opaque, they cover a pixel by 0.95 only where several overlap.
    faint = replace(balls.gaussians, opacity=np.full(len(balls.gaussians), 0.5, np.float32))
    source = rendered_views.RenderedViews(faint, balls.views, NEAR, replace(SHORT, covered_share=0.95), whole=False)
    assert len(source.drawn(0, 1e-3).mask) == 0 < len(source[0].mask)
    training = paper._CodebookTraining(source, torch.rand((len(source.known), 6)), SHORT)
    monkeypatch.setattr(paper, "SIZES", 1000)
    together = paper._Parts([np.arange(len(source.known))], [4], np.zeros((len(source.known), 0), np.float32))
    view, target, rows = training._draw(Never(), together)  # pyright: ignore
    assert len(target) == int(rows.sum()) > 0
    assert len(view.mask) == len(source[0].mask)


def test_more_clusters_than_gaussians(balls: Balls) -> None:
    few = Gaussians(*(getattr(balls.gaussians, name)[::100] for name in ("xyz", "scale", "rotation", "opacity")))
    few = replace(few, scale=few.scale * 6)
    settings = replace(SHORT, schedule_share=0.0005, k1=64, covered_share=0)
    trained = train_features(few, balls.views, settings)
    book = train_codebook(few, balls.views, trained.raw, settings)
    assert (book.leaf[trained.seen > 0] >= 0).all()
    assert book.centers.shape == (64 * 3, 6)


class Killed(Exception):
    """In place of a kill."""


@pytest.mark.parametrize(
    "stop",
    [
        ("features", 7),
        pytest.param(("coarse codebook", 13), marks=pytest.mark.slow),
        ("fine codebook", 20),
        pytest.param(("end", 0), marks=pytest.mark.slow),
    ],
)
def test_a_killed_training_continues_and_ends_with_the_same_bits(
    balls: Balls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: tuple[str, int]
) -> None:
    """With a checkpoint after every fifth step, and reassignments between them."""
    settings = replace(SHORT, schedule_share=0.001, coarse_interval=6, fine_interval=6)
    calls, keep = itertools.count(), WorkFolder.replace
    monkeypatch.setattr(paper, "CHECKPOINT_SECONDS", 0)
    monkeypatch.setattr(WorkFolder, "replace", lambda *given: next(calls) % 5 or keep(*given))

    def train(work: WorkFolder | None, stop: tuple[str, int] | None = None) -> tuple[Any, Any]:
        def progress(name: str, step: int, _count: int, _loss: float) -> None:
            if (name, step) == stop:
                raise Killed

        run = paper.TrainingRun(3, progress, work)
        trained = train_features(balls.gaussians, balls.views, settings, run)
        book = train_codebook(balls.gaussians, balls.views, trained.raw, settings, run)
        if stop == ("end", 0):
            raise Killed
        return trained, book

    expected, expected_book = train(None)
    with pytest.raises(Killed), WorkFolder.open(tmp_path / "work") as work:
        train(work, stop)
    with WorkFolder.open(tmp_path / "work") as work:
        resumed, book = train(work)
    stages, expected_stages = (
        {stage.name: stage for stage in (a.history, *b.histories)}
        for a, b in ((resumed, book), (expected, expected_book))
    )
    assert 0 < stages.get(stop[0], stages["features"]).resumed_at < 20
    assert all(stages[name].loss == stage.loss for name, stage in expected_stages.items())
    np.testing.assert_array_equal(resumed.features, expected.features)
    np.testing.assert_array_equal(book.leaf, expected_book.leaf)
    np.testing.assert_array_equal(book.centers, expected_book.centers)
    assert not (tmp_path / "work").exists()


def test_checkpoints_of_other_settings_or_seeds_are_not_taken(balls: Balls, tmp_path: Path) -> None:
    settings = replace(SHORT, schedule_share=0.0005)
    with WorkFolder.open(tmp_path / "work") as work:
        for each, seed in ((settings, 0), (settings, 1), (replace(settings, feature_rate=0.02), 0), (settings, 0)):
            run = paper.TrainingRun(seed, work=work)
            trained = train_features(balls.gaussians, balls.views, each, run)
            alone = train_features(balls.gaussians, balls.views, each, paper.TrainingRun(seed))
            np.testing.assert_array_equal(trained.features, alone.features)
        assert trained.history.resumed_at == trained.history.steps == 10


def test_progress_names_stage_step_total_and_loss(balls: Balls) -> None:
    heard: list[tuple[str, int, int, float]] = []
    settings = replace(SHORT, schedule_share=0.0002, schedule="lerf")
    run = paper.TrainingRun(progress=lambda *a: heard.append(a))
    trained = train_features(balls.gaussians, balls.views, settings, run)
    assert [row[:3] for row in heard] == [("features", 1, 2), ("features", 2, 2)]
    assert heard[1][3] == pytest.approx(np.mean(trained.history.loss))
    assert trained.history.published_steps == 10_000
    assert trained.history.seconds > 0
    assert trained.history.published_seconds == pytest.approx(10_000 * trained.history.seconds / 2)


def test_views_without_covered_masks_are_refused(balls: Balls) -> None:
    with pytest.raises(SceneError, match="none of the 6 views has a mask of which Gaussians cover"):
        train_features(balls.gaussians, balls.views, replace(SHORT, covered_share=1.1))


def test_a_view_with_one_mask_has_no_separation() -> None:
    separation, _ = paper.view_losses(torch.rand(5, 6), torch.zeros(5, dtype=torch.int64), PaperSettings())
    assert separation.item() == 0


def test_missing_torch_names_the_extra() -> None:
    code = "import sys; sys.modules['torch'] = None; import og_pointcloud.fitting.learned.paper"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'og-pointcloud[learn]'" in run.stderr.splitlines()[-1]


def cells_of(name: str, cell: str) -> Any:
    return cell if name in ("schedule", "formula", "device", "matching.score") else ast.literal_eval(cell)


def test_the_page_names_every_number_and_no_other() -> None:
    """Ours are the defaults; the authors' columns are what `of_authors` sets."""
    rows = [
        [cell.strip() for cell in line.strip("|\n").split("|")]
        for line in PAGE.read_text().splitlines()
        if line.startswith("| `")
    ]
    records = {"scannet": PaperSettings.of_authors(), "lerf": PaperSettings.of_authors("lerf"), "ours": PaperSettings()}
    names = [row[0].strip("`") for row in rows]
    fields = [field.name for field in dataclasses.fields(PaperSettings) if field.name != "matching"]
    of_matching = [f"matching.{field.name}" for field in dataclasses.fields(PaperSettings().matching)]
    assert sorted(names) == sorted([*fields, *of_matching])
    for name, (_, _, scannet, lerf, ours, why) in zip(names, rows, strict=True):
        for dataset, cell in (("scannet", scannet), ("lerf", lerf), ("ours", ours)):
            assert cells_of(name, cell) == operator.attrgetter(name)(records[dataset]), (name, dataset)
        assert why


def test_of_authors_takes_changes() -> None:
    settings = PaperSettings.of_authors("lerf", k1=32, position_weight=0.1)  # teatime
    assert (settings.k1, settings.k2, settings.position_weight, settings.matching.min_views) == (32, 10, 0.1, 5)


@pytest.mark.parametrize(("most", "stride"), [(64 * 48, 1), (64 * 48 - 1, 2), (32 * 24, 2), (1, 48)])
def test_images_are_thinned_to_so_many_pixels(most: int, stride: int) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    view = View("v", camera, np.zeros((48, 64), np.int32), np.ones((1, 2), np.float32))
    journal = Journal(False)
    assert stride_for_pixels([view], most, journal) == stride
    assert [numbers["stride"] for _, numbers in journal.left_out] == [stride] * (stride > 1)


def test_some_gaussians_drawn_alone_are_those_of_a_scene_of_them(balls: Balls) -> None:
    source = rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, SHORT, whole=False)
    members = np.flatnonzero(balls.object_ids[source.known] == 0)
    alone = source.drawn(2, 0.5, 0, members)
    own = balls.gaussians.take(source.known[members])
    own = replace(own, scale=own.scale * np.float32(0.5))
    weights = view_weights(own, balls.views[2].camera, NEAR).toarray()
    covered = (weights.sum(axis=1) >= SHORT.covered_share) & (balls.views[2].mask_map().ravel() >= 0)
    assert 0 < len(alone.mask) == covered.sum()
    np.testing.assert_allclose(alone.weights.toarray()[:, members], weights[covered], atol=1e-5)
    assert alone.weights.shape[1] == len(source.known)
    assert source.drawn(2, 0.5, 0, members) is alone


def test_the_curve_of_a_stage_is_its_losses_in_stretches() -> None:
    history = paper.StageHistory("features", 20_000, 2.0, [float(step) for step in range(1000)])
    curve = history.to_dict()["loss"]
    assert len(curve) == paper.CURVE_POINTS
    np.testing.assert_allclose(curve, np.arange(1000).reshape(200, 5).mean(axis=1), rtol=1e-3)
    assert paper.StageHistory("features", 20_000, 0.0, [3.0]).to_dict()["loss"] == [3.0]


@pytest.fixture
def shapes(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(PAGE.parents[1] / "examples"))
    return importlib.import_module("trained_shapes")


def test_shapes_are_trained_and_places_stay(balls: Balls, shapes: Any) -> None:
    settings = replace(SHORT, schedule_share=0.001)
    source = rendered_views.RenderedViews(balls.gaussians, balls.views, NEAR, settings, whole=False)
    raw, features, trained = shapes.train_with_shapes(source, settings, 0)
    new, old = trained.gaussians, balls.gaussians
    assert new.xyz is old.xyz
    assert new.rotation is old.rotation
    seen = trained.seen > 5
    for moved in (np.log(new.scale[seen, 0] / old.scale[seen, 0]), (new.opacity - old.opacity)[seen]):
        assert 1e-4 < np.abs(moved).mean() < 0.5
    assert ((new.opacity > 0) & (new.opacity < 1)).all()
    assert (features[trained.seen == 0] == 0).all()
    again, *_ = shapes.train_with_shapes(source, settings, 0)
    np.testing.assert_array_equal(raw, again)


@pytest.mark.parametrize("round_", [True, False], ids=["round", "needles"])
def test_shapes_have_the_gradient_of_finite_differences(round_: bool, shapes: Any) -> None:
    """In float64 and without tiles (reference_splatting.py), a step at a time of each opacity and log size."""
    rng, n = np.random.default_rng(0), 25
    xyz = (rng.random((n, 3)) + np.array([-0.5, -0.5, 2])).astype(np.float32)
    scale = np.full((n, 3), 0.12) if round_ else 0.01 + 0.2 * rng.random((n, 3))
    turned = rng.normal(size=(n, 4))
    rotation = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    gaussians = Gaussians(xyz, scale.astype(np.float32), rotation, (0.2 + 0.5 * rng.random(n)).astype(np.float32))
    camera = Camera(20, 16, 24.0, 24.0, 10.0, 8.0, np.eye(4))
    view = View(
        "v", camera, (np.arange(320).reshape(16, 20) % 20 < 10).astype(np.int32) - 1, np.ones((1, 2), np.float32)
    )
    source = rendered_views.RenderedViews(gaussians, [view], NEAR, replace(SHORT, covered_share=0), whole=False)
    pixels, known = source[0].pixels, source.known
    np.testing.assert_array_equal(pixels, np.flatnonzero(view.mask_map().ravel() == 0))
    values, pull = rng.random((len(known), 6)), rng.normal(size=(len(pixels), 6))

    def loss(opacity: NDArray[np.float64], log_size: NDArray[np.float64]) -> float:
        larger = gaussians.scale.astype(np.float64) * np.exp(log_size)[:, None]
        weights = reference_pixel_weights(replace(gaussians, scale=larger, opacity=opacity), camera, NEAR)
        return float((weights.reshape(320, n)[pixels][:, known] @ values * pull).sum())

    found = shapes.shape_gradient(source, source[0], values, pull)
    at, step = (gaussians.opacity.astype(np.float64), np.zeros(n)), 1e-6 * np.eye(n)
    expected = [
        [(loss(at[0] + s, at[1]) - loss(at[0] - s, at[1])) / 2e-6 for s in step],
        [(loss(at[0], at[1] + s) - loss(at[0], at[1] - s)) / 2e-6 for s in step],
    ]
    for got, slow in zip(found, np.array(expected), strict=True):
        np.testing.assert_allclose(got, slow, rtol=0, atol=1e-5 * np.abs(slow).max())


def test_the_figures_of_two_balls(tiny_capture: TinyCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Example 11: of the default way the clicked ball is lit, gone, and painted, and the other stays."""
    arguments = ["example", str(tiny_capture.folder), "red ball", "-o", str(tmp_path), "--share", "0.002"]
    monkeypatch.setattr(sys, "argv", arguments)
    runpy.run_path(str(PAGE.parents[1] / "examples" / "11_paper_figures.py"), run_name="__main__")
    assert cv2.imread(str(tmp_path / "features.png")).std() > 10
    sheet = cv2.imread(str(tmp_path / "objects.png")).astype(int)
    height, width = sheet.shape[0] // 2, sheet.shape[1] // 3
    lit, gone, painted = (sheet[height:, i * width : (i + 1) * width] for i in range(3))
    red = [((panel[..., 2] - panel[..., :2].max(axis=2)) > 60).sum() for panel in (lit, gone, painted)]
    blue = [((panel[..., 0] - panel[..., 1:].max(axis=2)) > 60).sum() for panel in (lit, gone, painted)]
    assert red[0] > 50
    assert max(red[1:]) < 0.1 * red[0]
    assert blue[2] > blue[1] + 0.5 * red[0]
