"""Files from strangers: every reader is given thousands of damaged and lying files, and must read or refuse each.

    python examples/fuzz_readers.py --count 20000 --seconds 100
    python examples/fuzz_readers.py --reader "PLY, ascii" --seed 0 --only 1234   # one input again, with its traceback

A file is refused as it should be if the reader raises one of the library's errors (or FileNotFoundError) with one line
of at most 400 printable characters. Anything else is unexpected: another exception, a RuntimeWarning, a broken promise
of what was read, more than 256 MB for files of some kilobytes, a crash, more than 5 s. Input i of a seed is always the
same. Each reader runs in a process of its own, which is ended and started anew where it hangs or crashes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

from fuzz_changes import changed, mended, packed
from fuzz_files import READERS, Files, Reader

__all__ = ["Tally", "fuzz", "main", "make_input", "try_input"]

MOST_SECONDS = 5.0
"""Of processor time."""
MOST_WAIT_S = 60.0
"""Without any answer, by the clock."""
MOST_BYTES = 1 << 28
"""What reading may take beyond what the process has after it read the valid files."""
LONGEST_MESSAGE = 400
SHOWN = 5


@dataclass
class Tally:
    """What became of a reader's inputs. kinds: different refusals, numbers and names left out of them.

    unexpected: (number of the input, what happened).
    """

    read: int = 0
    refused: int = 0
    kinds: set[str] = field(default_factory=set)
    unexpected: list[tuple[int, str]] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def tried(self) -> int:
        """All inputs."""
        return self.read + self.refused + len(self.unexpected)


def make_input(reader: Reader, seeds: Sequence[Files], seed: int, number: int) -> Files:
    """Input ``number`` of a seed: one of the valid folders, in which one file (rarely two) is changed or missing."""
    random = Random(f"{reader.name}/{seed}/{number}")
    valid = random.choice(seeds)
    files = dict(valid)
    for _ in range(random.choice((1, 1, 1, 1, 2))):
        name = random.choice(list(valid))
        if random.random() < 0.01:
            files.pop(name, None)
        elif random.random() < 0.01:
            files[name] = files.get(random.choice(list(valid)), b"")
        elif name in files:
            files[name] = changed(random, name, files[name])
    if "manifest.json" in files and random.random() < 0.8:
        files = mended(files, valid)
    return {"scene.ogpc": packed(files)} if reader.whole else files


def try_input(reader: Reader, files: Files, folder: Path) -> tuple[str, str]:
    """("read" or "refused" or "unexpected", what was said). folder: will hold the files, and no others."""
    _fill(folder, files)
    begin = time.process_time()
    outcome, says = _outcome(reader, folder)
    if (seconds := time.process_time() - begin) > MOST_SECONDS:
        return "unexpected", f"{seconds:.1f} s of processor time; then {outcome}"
    return outcome, says


def _outcome(reader: Reader, folder: Path) -> tuple[str, str]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            reader.read(folder)
    except reader.errors as error:
        says = str(error).replace(str(folder), "")
        if len(says) > LONGEST_MESSAGE or not says.isprintable():
            return "unexpected", f"a message of {len(says)} characters: {says[:120]!r}"
        return "refused", says
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a panic of compiled code is no Exception
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "og_pointcloud" in frame.filename]
        where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "fuzz_files.py"
        return "unexpected", f"{type(error).__name__} at {where}: {str(error).replace(str(folder), '')[:160]!r}"
    return "read", ""


def fuzz(reader: Reader, count: int, seed: int, seconds: float) -> Tally:
    """``count`` inputs, or as many as the seconds allow."""
    tally, first, begin = Tally(), 0, time.perf_counter()
    context = multiprocessing.get_context("spawn")
    while first < count and (left := seconds - (time.perf_counter() - begin)) > 0:
        ours, theirs = context.Pipe(duplex=False)
        current = context.Value("q", -1)
        process = context.Process(target=_work, args=(reader.name, seed, range(first, count), left, current, theirs))
        process.start()
        theirs.close()
        first = _follow(process, current, ours, tally) + 1
    tally.seconds = time.perf_counter() - begin
    return tally


def _work(name: str, seed: int, numbers: range, seconds: float, current: Any, results: Connection) -> None:
    """In the process: outcome of each input into ``results``, its number into ``current`` before it is tried."""
    reader, folder = READERS[name], Path(tempfile.mkdtemp(prefix="fuzz"))
    try:
        seeds = reader.seeds()
        for files in seeds:
            whole = {"scene.ogpc": packed(files)} if reader.whole else files
            outcome, says = try_input(reader, whole, folder)
            if outcome != "read":
                raise AssertionError(f"{name}: a valid file is {outcome}: {says}")
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        with Path(os.devnull).open("wb") as nowhere:  # the complaints of image libraries, a line or two an input
            os.dup2(nowhere.fileno(), sys.stderr.fileno())
        end = time.perf_counter() + seconds
        for number in numbers:
            current.value = number
            results.send((number, *try_input(reader, make_input(reader, seeds, seed, number), folder)))
            if time.perf_counter() > end:
                break
        results.send((numbers.stop, "done", ""))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _follow(process: Any, current: Any, results: Connection, tally: Tally) -> int:
    """Take the process's results until it is done, hangs or dies; the number of its last input."""
    number, outcome, says = -1, "", ""
    try:
        while outcome != "done":
            if not results.poll(MOST_WAIT_S):
                process.kill()
                raise EOFError
            number, outcome, says = results.recv()
            if outcome != "done":
                _count(tally, number, outcome, says)
    except EOFError:
        process.join()
        number = current.value
        if number < 0:
            raise SystemExit("a valid file is not read: see above") from None
        _count(tally, number, "unexpected", f"the process ended with {process.exitcode}, or was stopped after a minute")
    process.join()
    return number


def _count(tally: Tally, number: int, outcome: str, says: str) -> None:
    if outcome == "read":
        tally.read += 1
    elif outcome == "refused":
        tally.refused += 1
        tally.kinds.add(re.sub(r"'.*?'|\"[^\"]*\"|b?[^a-z ]*[0-9][^ ]*|\(.*?\)", "*", says)[:60])
    else:
        tally.unexpected.append((number, says))


def _fill(folder: Path, files: Files) -> None:
    """Make the folder hold these files and no others."""
    for path in [path for path in folder.rglob("*") if path.is_file() and str(path.relative_to(folder)) not in files]:
        path.unlink()
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a line for each reader, and below it the first inputs of each unexpected kind; 1 if there was any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reader", action="append", choices=list(READERS), help="left out: all, one after the other")
    parser.add_argument("--count", type=int, default=1000, help="inputs of each reader (1000)")
    parser.add_argument("--seconds", type=float, default=60, help="at most so long for each reader (60)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this input alone, in this process, its error let through")
    options = parser.parse_args(arguments)
    names = options.reader or list(READERS)
    if options.only is not None:
        return _again(READERS[names[0]], options.seed, options.only)
    print(f"{'reader':<26}{'tried':>8}{'refused':>9}{'kinds':>7}{'read':>7}{'unexpected':>12}{'per s':>7}")
    failed = False
    for name in names:
        tally = fuzz(READERS[name], options.count, options.seed, options.seconds)
        numbers = f"{tally.tried:>8}{tally.refused:>9}{len(tally.kinds):>7}{tally.read:>7}{len(tally.unexpected):>12}"
        print(f"{name:<26}{numbers}{tally.tried / tally.seconds:>7.0f}", flush=True)
        failed |= bool(tally.unexpected)
        kinds: dict[str, list[tuple[int, str]]] = {}
        for number, says in tally.unexpected:
            kinds.setdefault(re.sub(r"[0-9]{2,}|'.*", "*", says)[:70], []).append((number, says))
        for found in kinds.values():
            again = ", ".join(str(number) for number, _ in found[:SHOWN])
            print(f"    {len(found)} times: {found[0][1]}")
            print(f"        --reader {name!r} --seed {options.seed} --only {again}")
    return int(failed)


def _again(reader: Reader, seed: int, number: int) -> int:
    files = make_input(reader, reader.seeds(), seed, number)
    with tempfile.TemporaryDirectory() as folder:
        _fill(Path(folder) / "input", files)
        for name, data in files.items():
            print(f"{name}: {len(data)} bytes, {data[:300]!r}")
        reader.read(Path(folder) / "input")
    print("read")
    return 0


if __name__ == "__main__":
    sys.exit(main())
