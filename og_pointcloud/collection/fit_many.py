"""Many captures -> a .ogpc file each, on any executor. One that fails or dies does not affect the others."""

from __future__ import annotations

import os
import socket
import threading
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, as_completed
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from multiprocessing import current_process
from pathlib import Path
from typing import Any, Literal

from og_pointcloud.ask.hosts import import_plugin
from og_pointcloud.bundle.read import read_bundle
from og_pointcloud.bundle.vocabulary import scene_words
from og_pointcloud.checking.check import CaptureWarning, check_words, with_checks
from og_pointcloud.cloud import FeatureSpace, LabelledCloud
from og_pointcloud.errors import OgPointcloudError
from og_pointcloud.fitting.fit import fit
from og_pointcloud.fitting.memory import peak_memory
from og_pointcloud.fitting.tasks import LocalWorkers, Share, share_here
from og_pointcloud.formats.atomic import StrPath
from og_pointcloud.formats.capture import read_capture
from og_pointcloud.formats.tables import naming
from og_pointcloud.journal import LeftOut, with_bar
from og_pointcloud.kernels import use_threads
from og_pointcloud.settings import FitSettings

LOST = "lost"
"""`CaptureFit.worker` of a fit whose worker died."""


@dataclass(frozen=True)
class FitOptions:
    """How captures are read and fitted: arguments of `read_capture`, `fit` and `scene_words`.

    >>> og.FitOptions(og.FitSettings(mode="grouping")).settings.mode
    'grouping'
    """

    settings: FitSettings = field(default_factory=FitSettings)
    gaussians: str | Path | None = None
    mask_level: Literal["default", "small", "medium", "large"] | None = None
    text_features: StrPath | None = None
    word_bank: StrPath | None = None


@dataclass(frozen=True)
class CaptureFit:
    """Outcome of a capture. state: "fitted", "was there" (its file is whole already) or "failed", then with the cause.
    worker: host:process, or "lost". peak_bytes: peak memory of this process so far, 0 if unknown. doubts: names of the
    checks that failed (the file's provenance says why). warnings: all other warnings.

    >>> og.CaptureFit("scans/kitchen", "fitted/kitchen.ogpc", "was there").name
    'kitchen'
    """

    capture: str
    output: str
    state: Literal["fitted", "was there", "failed"]
    cause: str = ""
    seconds: float = 0.0
    points: int = 0
    instances: int = 0
    worker: str = ""
    peak_bytes: int = 0
    doubts: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The capture's name: the last part of its path."""
        return Path(self.capture).name


def fit_many(
    captures: StrPath | Iterable[StrPath],
    out: StrPath,
    executor: Executor | None = None,
    *,
    options: FitOptions | None = None,
    progress: bool = True,
) -> tuple[CaptureFit, ...]:
    """Fit one or more captures, each as a task, to ``out``/NAME.ogpc, NAME being the last part of a capture's path.

    executor: any of `concurrent.futures`; None: processes on this machine. For a Dask cluster, use
    ``dask.distributed.Client(address).get_executor(pure=False)``; its workers must see captures and ``out``.
    A task takes its share of the worker's memory and cores; `FitSettings.memory` limits each.

    Files that are there and whole are left as they are; killed fits resume after the views that they kept. Returns the
    outcome of each, in the given order; nothing is raised for a capture that fails. Warnings name the capture. The
    files do not depend on where and in what order they were made: they hold no times, which are in the returned
    records. OgPointcloudError, before any work, for two captures of one name, and in a script that calls it at its top
    level without an executor: its processes import the script, which would run once more in each.

    >>> og.fit_many([], "out")
    ()
    """
    if executor is None and getattr(current_process(), "_inheriting", False):  # as Python's own guard asks
        raise OgPointcloudError(
            "fit_many was called while one of its own processes imported this script; expected the call, and all other "
            "work of the script, under if __name__ == '__main__':"
        )
    if isinstance(captures, (str, os.PathLike)):  # do not iterate over the letters of a path
        captures = [captures]
    options, out = options or FitOptions(), Path(out).resolve()
    jobs = _outputs([Path(capture).resolve() for capture in captures], out)
    fits = {
        capture: CaptureFit(str(capture), str(path), "was there") for capture, path in jobs.items() if _is_whole(path)
    }
    todo = {capture: path for capture, path in jobs.items() if capture not in fits}
    if todo:
        with naming(out):
            out.mkdir(parents=True, exist_ok=True)
        with LocalWorkers(len(todo)) if executor is None else nullcontext(executor) as workers:
            fits |= _fit_all(workers, todo, options, progress)
    return tuple(fits[capture] for capture in jobs)


def _fit_all(
    workers: Executor, todo: Mapping[Path, Path], options: FitOptions, progress: bool
) -> dict[Path, CaptureFit]:
    """Fit captures to their files. Those whose workers die are tried once more at the end, when there is more room."""
    # Pools of the standard library share this machine; the machines of other executors are unknown.
    at_once = getattr(workers, "_max_workers", None)
    share = Share() if at_once is None else Share.of_machine(at_once)
    fits: dict[Path, CaptureFit] = {}
    for attempt in ("fit", "fit again"):
        pending = [capture for capture in todo if capture not in fits or fits[capture].worker == LOST]
        futures = {_submitted(workers, capture, todo[capture], options, share): capture for capture in pending}
        try:
            for future in with_bar(as_completed(futures), attempt, len(futures), progress and len(futures) > 0):
                fits[futures[future]] = found = _outcome(future, futures[future], todo[futures[future]])
                for text in found.warnings:
                    warnings.warn(f"{found.name}: {text}", stacklevel=3)
        finally:
            for future in futures:  # on an interrupt, those that have not begun
                future.cancel()
    return fits


def _submitted(workers: Executor, capture: Path, output: Path, options: FitOptions, share: Share) -> Future[CaptureFit]:
    try:
        return workers.submit(_try_fit, str(capture), str(output), options, share)
    except BrokenExecutor as error:  # a pool of processes takes nothing more once one of them has died
        broken: Future[CaptureFit] = Future()
        broken.set_exception(error)
        return broken


def _outcome(future: Future[CaptureFit], capture: Path, output: Path) -> CaptureFit:
    try:
        return future.result()
    except Exception as error:  # of the executor: a task returns its own
        cause = (
            f"its worker died ({type(error).__name__}: {error!s:.160}), as one does that runs out of memory; expected "
            "workers that finish their tasks: take fewer, with more memory each, or limit that of a fit (--memory)"
        )
        return CaptureFit(str(capture), str(output), "failed", cause, worker=LOST)


def _outputs(captures: Sequence[Path], out: Path) -> dict[Path, Path]:
    """The file of each capture."""
    names: dict[str, Path] = {}
    for capture in captures:
        if names.setdefault(capture.name, capture) != capture:
            raise OgPointcloudError(
                f"'{names[capture.name]}' and '{capture}' would both become {capture.name}.ogpc; expected folders "
                "with different names: fit them into different folders"
            )
    return {capture: out / f"{name}.ogpc" for name, capture in names.items()}


def _is_whole(path: Path) -> bool:
    try:
        read_bundle(path)
    except OgPointcloudError:
        return False
    return True


def _try_fit(capture: str, output: str, options: FitOptions, share: Share) -> CaptureFit:
    """The task: never raises, as not every error survives the transfer from another process."""
    start, worker = time.perf_counter(), f"{socket.gethostname()}:{os.getpid()}"
    messages: list[str] = []
    try:
        with _recorded(messages):
            cloud = _fit(Path(capture), Path(output), options, share_here(share))
    except Exception as error:
        # Our own errors, the system's and missing extras say what is wrong; for any other, its type is added.
        expected = isinstance(error, (OgPointcloudError, OSError, ImportError))
        cause = str(error) if expected and str(error) else f"{type(error).__name__}: {error}"
        if isinstance(error, OSError) and error.filename:
            cause = f"'{error.filename}': {error.strerror}"
        result = CaptureFit(capture, output, "failed", cause)
    else:
        doubts = tuple(check["name"] for check in cloud.provenance["checks"] if check["verdict"] == "doubt")
        result = CaptureFit(capture, output, "fitted", points=len(cloud), instances=len(cloud.instances), doubts=doubts)
        messages += cloud.provenance["warnings"]
    seconds = round(time.perf_counter() - start, 3)
    return replace(result, seconds=seconds, worker=worker, peak_bytes=peak_memory(), warnings=tuple(messages))


@contextmanager
def _recorded(messages: list[str]) -> Iterator[None]:
    """Adds the warnings of a fit to ``messages``, except doubts, which its provenance has. Python cannot tell apart
    those of several threads: in a thread they are issued as usual."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("ignore")  # those that libraries address to programmers
        warnings.simplefilter("always", UserWarning)
        try:
            yield
        finally:
            messages += [str(warning.message) for warning in found if not issubclass(warning.category, CaptureWarning)]


def _fit(capture: Path, output: Path, options: FitOptions, share: Share) -> LabelledCloud:
    if share.threads is not None:
        use_threads(share.threads)
    # The user's limit or this task's share of the machine, whichever is less.
    limits = [limit for limit in (options.settings.memory, share.memory) if limit is not None]
    settings = replace(options.settings, memory=min(limits, default=None))
    work = output.with_name(f"{output.name}.work")
    cloud = fit_capture(capture, replace(options, settings=settings), work=work)
    cloud = replace(cloud, provenance=_reproducible(cloud.provenance, options.settings))
    import_plugin("og_pointcloud_export", "fit").write_bundle(cloud, output)
    return cloud


def fit_capture(
    capture: Path, options: FitOptions, *, work: Path | None, executor: Executor | None = None, progress: bool = False
) -> LabelledCloud:
    """A capture's cloud with its words, not yet written. work, executor, progress: as in `fit`."""
    start = time.perf_counter()
    scene = read_capture(capture, gaussians=options.gaussians, mask_level=options.mask_level)
    space = FeatureSpace(scene.feature_space, scene.feature_width)
    words = scene_words(space, text_features=options.text_features, word_bank=options.word_bank, capture=capture)
    reading = {"name": "read capture", "seconds": round(time.perf_counter() - start, 4)}
    cloud = words.added_to(fit(scene, options.settings, work=work, executor=executor, progress=progress))
    cloud = with_checks(cloud, [check_words(cloud)])
    return replace(cloud, provenance={**cloud.provenance, "stages": [reading, *cloud.provenance["stages"]]})


def _reproducible(provenance: dict[str, Any], settings: FitSettings) -> dict[str, Any]:
    """Provenance without anything that depends on where, when and beside what a fit ran: files are reproducible."""
    return {
        **provenance,
        "settings": {**provenance["settings"], "memory": settings.memory},
        "stages": [],
        "left_out": [entry for entry in provenance["left_out"] if entry["key"] != LeftOut.RENDERING.key],
        "notes": {name: note for name, note in provenance["notes"].items() if name != "table"},
    }
