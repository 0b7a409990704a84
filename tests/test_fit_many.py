"""Many captures on any executor: the same files wherever they are made, and one that fails or dies harms no other."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import error_of, output_of, run
from scenes import write_tiny_capture

import og_pointcloud as og
from og_pointcloud.collection import fit_many as module
from og_pointcloud.errors import MissingExtraError, OgPointcloudError, SceneError
from og_pointcloud.fitting.tasks import LocalWorkers, Share, dask_executor, run_tasks, share_here
from og_pointcloud.journal import Journal, LeftOut
from og_pointcloud.settings import FitSettings


class Inline(Executor):
    """Runs each task when it is submitted."""

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture(scope="module")
def captures(tmp_path_factory) -> list[Path]:
    """Of 3 and 4 views, so that every file is another."""
    folder = tmp_path_factory.mktemp("captures")
    return [write_tiny_capture(folder / f"capture{views}", views).folder for views in (3, 4)]


class KilledWorker(Exception):
    """As Dask calls what it raises for a task whose workers died of it."""


@pytest.mark.parametrize("kind", [BrokenProcessPool, KilledWorker])
def test_a_worker_that_dies_is_one_error(kind):
    def died(*_):
        future = Future()
        future.set_exception(kind("terminated abruptly"))
        return future

    executor = SimpleNamespace(submit=died)
    with pytest.raises(OgPointcloudError, match=r"a worker died, .* expected workers that finish their tasks"):
        run_tasks(executor, Journal(progress=False), abs, [1, 2], "tasks")


def test_the_output_is_a_folder(captures, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(SceneError, match="file: File exists: check the path"):
        og.fit_many(captures, tmp_path / "file", Inline(), progress=False)


@pytest.fixture(scope="module")
def one_by_one(captures, tmp_path_factory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("one_by_one")
    fits = og.fit_many(captures, out, Inline(), progress=False)
    assert [(fit.state, fit.points, fit.instances) for fit in fits] == [("fitted", 1576, 2)] * 2
    assert [Path(fit.output).name for fit in fits] == [f"{path.name}.ogpc" for path in captures]
    return contents(out)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_file_is_what_fit_and_write_bundle_make(captures, one_by_one, tmp_path):
    (tmp_path / "a.ogpc").write_bytes(one_by_one["capture3.ogpc"])
    scene, cloud = og.load(tmp_path / "a.ogpc"), og.fit(og.read_capture(captures[0]), progress=False)
    assert scene.instance_ids.tolist() == cloud.instance_ids.tolist()
    assert "lamp" in scene.vocabulary.names
    assert scene.cloud.provenance["settings"] == json.loads(json.dumps(cloud.provenance["settings"]))


@pytest.mark.slow
def test_threads_make_the_same_files(captures, one_by_one, tmp_path):
    with ThreadPoolExecutor(2) as executor:
        og.fit_many(captures, tmp_path, executor, progress=False)
    assert contents(tmp_path) == one_by_one


@pytest.mark.slow
def test_processes_make_the_same_files(captures, one_by_one, tmp_path):
    before = dict(os.environ)
    fits = og.fit_many(captures, tmp_path, progress=False)
    assert str(os.getpid()) not in {fit.worker.partition(":")[2] for fit in fits}
    assert contents(tmp_path) == one_by_one
    assert dict(os.environ) == before


def test_what_is_there_stays_and_what_is_damaged_is_made_again(captures, one_by_one, tmp_path):
    for name in ("capture3.ogpc", "capture4.ogpc"):
        (tmp_path / name).write_bytes(one_by_one[name][: 5000 if name == "capture4.ogpc" else None])
    kept = (tmp_path / "capture3.ogpc").stat().st_mtime_ns
    fits = og.fit_many(captures, tmp_path, Inline(), progress=False)
    assert [fit.state for fit in fits] == ["was there", "fitted"]
    assert (tmp_path / "capture3.ogpc").stat().st_mtime_ns == kept
    assert contents(tmp_path) == one_by_one


def test_a_broken_capture_leaves_the_others(captures, one_by_one, tmp_path):
    broken = write_tiny_capture(tmp_path / "broken").folder
    (broken / "transforms.json").write_text("{")
    out = tmp_path / "out"
    fits = og.fit_many([broken, tmp_path / "nowhere", captures[0]], out, Inline(), progress=False)
    assert [fit.state for fit in fits] == ["failed", "failed", "fitted"]
    assert "transforms.json is not valid JSON" in fits[0].cause
    assert "nowhere" in fits[1].cause
    assert contents(out) == {"capture3.ogpc": one_by_one["capture3.ogpc"]}


def test_a_full_disk_is_said_and_leaves_no_half_file(captures, tmp_path, monkeypatch):
    original = module.import_plugin

    def write(cloud, path):
        if path.stem == "capture4":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return original("og_pointcloud_export", "fit").write_bundle(cloud, path)

    monkeypatch.setattr(module, "import_plugin", lambda *_: type("exporter", (), {"write_bundle": staticmethod(write)}))
    fits = og.fit_many(captures, tmp_path, Inline(), progress=False)
    assert [fit.state for fit in fits] == ["fitted", "failed"]
    assert fits[1].cause == f"'{tmp_path / 'capture4.ogpc'}': No space left on device"
    assert sorted(contents(tmp_path)) == ["capture3.ogpc"]


def test_circumstances_are_not_in_the_files():
    journal = Journal(False)
    with journal.stage("visibility"):
        journal.leave_out(LeftOut.RENDERING, count=2, folder="a.work")  # of a fit that was interrupted
    journal.leave_out(LeftOut.SPANNING_MASKS, count=1)
    whole, settings = Journal(False), FitSettings(memory=10**9)
    whole.leave_out(LeftOut.SPANNING_MASKS, count=1)
    kept = [
        module._reproducible(one.provenance(replace(settings, memory=memory)), settings)
        for one, memory in ((journal, 10**8), (whole, 10**7))
    ]
    assert kept[0] == kept[1]


@pytest.mark.parametrize("kind", [str, Path])
def test_one_path_is_one_capture_and_not_its_letters(captures, tmp_path, kind):
    [made] = og.fit_many(kind(captures[0]), tmp_path / "out", Inline(), progress=False)
    assert (made.name, made.state) == (captures[0].name, "fitted")


def test_two_captures_of_one_name_are_refused(captures, tmp_path):
    with pytest.raises(OgPointcloudError, match=r"would both become capture3.ogpc"):
        og.fit_many([captures[0], tmp_path / "capture3"], tmp_path / "out", Inline())
    assert not (tmp_path / "out").exists()


def die(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_process_that_dies_fails_its_task_alone():
    workers = LocalWorkers(2)
    dead = workers.submit(die, 0)
    well = [workers.submit(abs, -k) for k in range(5)]
    assert [future.result() for future in well] == list(range(5))
    with pytest.raises(BrokenProcessPool, match="terminated abruptly"):
        dead.result()
    workers.shutdown()


class Deadly(Inline):
    """The worker that gets a capture dies, so many times."""

    def __init__(self, name: str, times: int) -> None:
        self.name, self.left = name, times

    def submit(self, fn, /, *args, **kwargs):
        if self.left and self.name in str(args[0]):
            self.left -= 1
            lost: Future = Future()
            lost.set_exception(BrokenProcessPool("A process was terminated abruptly"))
            return lost
        return super().submit(fn, *args, **kwargs)


@pytest.mark.parametrize(("times", "state"), [(1, "fitted"), (2, "failed")])
def test_a_fit_whose_worker_dies_is_tried_once_more(captures, tmp_path, times, state):
    workers = Deadly("capture3", times)
    (fit,) = og.fit_many(captures[:1], tmp_path, workers, progress=False)
    assert (fit.state, workers.left) == (state, 0)
    cause = r"its worker died \(BrokenProcessPool: .*, as one does that runs out of memory; .*: take fewer, with more"
    assert bool(re.match(cause, fit.cause)) == (state == "failed")


def test_a_pool_that_breaks_costs_only_what_it_had_left(captures, tmp_path):
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        (fit,) = og.fit_many(captures[:1], tmp_path, pool, progress=False)
        pool.submit(die, 0).exception()
        fits = og.fit_many(captures, tmp_path, pool, progress=False)
    assert fit.state == "fitted"
    assert [each.state for each in fits] == ["was there", "failed"]
    assert "its worker died (BrokenProcessPool" in fits[1].cause


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_and_does_not_run_once_more_in_each_process(captures, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"import og_pointcloud as og\nfits = og.fit_many([{str(captures[0])!r}], {str(tmp_path / 'out')!r})\n"
        "print('all done', fits[0].state)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100)
    assert "work of the script, under if __name__ == '__main__':" in done.stderr
    assert done.stdout == "all done failed\n"


def test_processes_end_with_the_one_that_started_them():
    """Also where it had no time to say so."""
    code = (
        "import os, signal\nfrom og_pointcloud.fitting.tasks import LocalWorkers\nif __name__ == '__main__':\n"
        "    workers = LocalWorkers(1)\n    print(workers.submit(os.getpid).result(), flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    started = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    worker = int(started.stdout.readline())
    try:
        started.communicate(timeout=60)  # the end of what the worker may write to, too
    except subprocess.TimeoutExpired:
        os.kill(worker, signal.SIGKILL)
        raise


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C reaches no process group there")
@pytest.mark.parametrize("busy", [False, True])
def test_ctrl_c_is_told_once_and_not_by_each_process(busy):
    """Neither while they start, nor in a task, nor by those that wait for one."""
    wait = "[workers.submit(abs, -1).result(), time.sleep(0.3)]" if busy else "None"
    code = (
        "import signal, time\nfrom og_pointcloud.fitting.tasks import LocalWorkers\nif __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which a shell's background jobs ignore
        f"    workers = LocalWorkers(2)\n    {wait}\n    workers.submit(time.sleep, 5)\n"
        "    try:\n        print('started', flush=True)\n        time.sleep(60)\n"
        "    except KeyboardInterrupt:\n        print('interrupted')\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        started.stdout.readline()
        time.sleep(1.0 if busy else 0.05)
        os.killpg(started.pid, signal.SIGINT)
        out, err = started.communicate(timeout=60)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)
    assert (out, err) == ("interrupted\n", "")


def test_warnings_come_with_the_capture_they_are_of(captures, one_by_one, tmp_path):
    odd = write_tiny_capture(tmp_path / "odd").folder
    [geometry] = odd.glob("*.ply")
    plain = og.read_points(geometry)
    vertices = np.vstack([plain.xyz, [[np.nan] * 3]]).astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    columns = "".join(f"property float {axis}\n" for axis in "xyz")
    geometry.write_bytes(f"{header}{columns}end_header\n".encode() + vertices.tobytes())
    with pytest.warns(UserWarning, match=r"^odd: .*1 of 1577 points contain NaN or infinity") as told:
        (fit,) = og.fit_many(odd, tmp_path / "out", Inline(), progress=False)
    assert [f"odd: {text}" for text in fit.warnings] == [str(warning.message) for warning in told]


def test_shares():
    share = Share.of_machine(1)
    assert share.threads >= Share.of_machine(10_000).threads == 1
    assert Share.of_machine(2).memory <= share.memory
    assert share_here(share) == share


def test_command(captures, one_by_one, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(module, "LocalWorkers", lambda tasks: nullcontext(Inline()))
    out, report = tmp_path / "out", tmp_path / "report.json"
    broken = tmp_path / "broken"
    broken.mkdir()
    code, stdout, stderr = run(capsys, "fit", captures[0], broken, "--out", out, "--json", report)
    assert (code, "1 fitted, 0 already there, 1 failed" in stdout) == (2, True)
    assert f"failed: {broken}" in stderr
    assert stderr.count(str(broken)) == 1
    assert "1 of 2 captures failed" in stderr
    assert [fit["state"] for fit in json.loads(report.read_text())["fits"]] == ["fitted", "failed"]
    assert contents(out) == {"capture3.ogpc": one_by_one["capture3.ogpc"]}
    assert "0 fitted, 1 already there" in output_of(capsys, "fit", captures[0], "--out", out)
    assert "expected --out DIR" in error_of(capsys, "fit", captures[0], captures[1], "-o", tmp_path / "x.ogpc")
    assert "--work needs a single" in error_of(capsys, "fit", captures[0], "--out", out, "--work", tmp_path / "w")


@pytest.mark.slow
def test_a_cluster_that_is_not_there(monkeypatch):
    if not _has_dask():
        with pytest.raises(MissingExtraError, match="cluster"), dask_executor("tcp://127.0.0.1:1"):
            pass
        return
    monkeypatch.setattr("og_pointcloud.fitting.tasks.CONNECT_TIMEOUT_S", 0.5)
    with pytest.raises(OgPointcloudError, match="no scheduler answers"), dask_executor("tcp://127.0.0.1:1"):
        pass


def _has_dask() -> bool:
    from importlib.util import find_spec

    return find_spec("distributed") is not None


@pytest.mark.slow
@pytest.mark.skipif(not _has_dask(), reason="needs the extra 'cluster': dask[distributed]")
def test_a_dask_cluster_makes_the_same_files_though_a_worker_dies(captures, one_by_one, tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, memory_limit="2GB", dashboard_address=None) as cluster,
        Client(cluster) as client,
        dask_executor(client.scheduler.address) as executor,
    ):
        share = executor.submit(partial(share_here, Share())).result()
        assert share == Share(1, int(0.6 * 2e9))
        threading.Thread(target=_kill_one, args=(client, tmp_path), daemon=True).start()
        fits = og.fit_many(captures, tmp_path, executor, progress=False)
    assert [fit.state for fit in fits] == ["fitted"] * 2, [fit.cause for fit in fits]
    assert contents(tmp_path) == one_by_one


def _kill_one(client, out: Path) -> None:
    """Kill a worker while it fits: as soon as a work folder is there."""
    pids = client.run(os.getpid)
    while not list(out.glob("*.work")):
        time.sleep(0.01)
    os.kill(next(iter(pids.values())), signal.SIGKILL)


CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"
ASKED = ("apc_shelf_B", "desk_colmap29", "nuscenes_frame", "ycb_0049", "ycb_0050")


@pytest.mark.slow
@pytest.mark.skipif(not CAPTURES.exists(), reason="needs the captures in ../shared/data")
def test_words_of_real_captures_find_their_scene_first(tmp_path):
    """Their features are of two kinds, from photographs and from a detector's words, under one feature space."""
    fits = og.fit_many([CAPTURES / name for name in ASKED], tmp_path / "fitted", Inline(), progress=False)
    assert {fit.state for fit in fits} == {"fitted"}
    collection = og.Collection.index(tmp_path / "fitted", tmp_path / "atlas", progress=False)
    where: dict[str, set[str]] = {}
    for name in ASKED:
        truth = np.load(CAPTURES / name / "gt.npz")
        counts = np.bincount(truth["cls"][truth["cls"] >= 0], minlength=len(truth["names"]))
        for cls in np.flatnonzero(counts >= 30):
            where.setdefault(str(truth["names"][cls]), set()).add(name)
    found = {word: collection.find(word, top=1)[0] for word in where}
    assert len(where) >= 18
    # A carton's masks fit hardly any word: of what does not fit, one may come first elsewhere.
    wrong = {word: best for word, best in found.items() if best.scene not in where[word]}
    assert not any(best.fits for best in wrong.values())
    assert len(wrong) <= 1
    assert sum(best.fits for best in found.values()) >= 12
    assert all(best.calibrated for best in found.values())
