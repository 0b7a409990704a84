"""Every public name has an example in its docstring, and every example holds."""

import doctest

import pytest

import og_pointcloud as og

CONSTANTS = {"BACKGROUND", "TOO_FAR", "UNKNOWN", "UNOBSERVED"}
NAMES = sorted(set(og.__all__) - CONSTANTS)
FINDER = doctest.DocTestFinder(recurse=False)


def run(name, known):
    """Runs the examples of one docstring on a copy of what is known; how many there are, and what they make known."""
    (example,) = FINDER.find(getattr(og, name), name, module=False, globs=known)
    count = len(example.examples)
    said: list[str] = []
    done = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=said.append, clear_globs=False)
    assert done.failed == 0, "".join(said)
    return count, example.globs


@pytest.fixture(scope="module")
def known():
    """What other examples start from: the cloud that LabelledCloud's own makes."""
    return run("LabelledCloud", {})[1]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_each_public_name_holds(name, known):
    assert run(name, {} if name == "LabelledCloud" else dict(known))[0] >= 1
