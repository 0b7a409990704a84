"""Each fault of mutations.py, made in a copy of the package, turns one of its tests red."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).resolve().parents[1]
FAILED = 1
"""What pytest exits with where tests have failed, and nothing else went wrong."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package, its compiled kernels too: a changed file alone is compiled anew."""
    folder = tmp_path_factory.mktemp("mutated")
    shutil.copytree(ROOT / "og_pointcloud", folder / "og_pointcloud", ignore=shutil.ignore_patterns("*.pyc"))
    return folder


@pytest.fixture
def changed(copy: Path, mutation: Mutation) -> Iterator[None]:
    """The fault in its file, taken back afterwards with the file's time, which compiled kernels are known by."""
    file = copy / "og_pointcloud" / mutation.file
    plain, times = file.read_text(encoding="utf-8"), (file.stat().st_atime_ns, file.stat().st_mtime_ns)
    file.write_text(plain.replace(mutation.old, mutation.new), encoding="utf-8")
    yield
    file.write_text(plain, encoding="utf-8")
    os.utime(file, ns=times)


def run(copy: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python in the copy's folder, which it imports from first."""
    paths = (copy, ROOT / "export", ROOT / "plugins", ROOT / "examples")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.release
def test_the_copy_is_what_is_imported(copy: Path):
    assert str(copy) in run(copy, "-c", "import og_pointcloud; print(og_pointcloud.__file__)").stdout


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name.replace(" ", "-"))
def test_text_to_change_stands_once(mutation: Mutation):
    found = (ROOT / "og_pointcloud" / mutation.file).read_text(encoding="utf-8").count(mutation.old)
    assert found == 1, f"'{mutation.old}' stands {found} times in {mutation.file}: mend tests/mutations.py"
    assert mutation.old != mutation.new


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name.replace(" ", "-"))
@pytest.mark.slow
@pytest.mark.release
@pytest.mark.usefixtures("changed")
def test_mutation_is_caught(copy: Path, mutation: Mutation):
    tests = [str(ROOT / "tests" / test) for test in mutation.tests]
    options = ["-x", "-q", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT)]
    result = run(copy, "-m", "pytest", *options, *tests)
    assert result.returncode == FAILED, f"{mutation.name}: {result.stdout[-2000:]}"
