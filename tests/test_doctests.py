"""Every public name has an example in its docstring, and every example of a docstring holds."""

import doctest
import importlib
from pathlib import Path

import pytest

import og_pointcloud as og

ROOT = Path(__file__).parents[1]
SOURCES = [path for folder in ("og_pointcloud", "export", "plugins") for path in (ROOT / folder).rglob("*.py")]
WITH_EXAMPLES = [path for path in SOURCES if ">>> " in path.read_text()]
CONSTANTS = {"BACKGROUND", "TOO_FAR", "UNKNOWN", "UNOBSERVED"}
OPTIONS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def example_of(name):
    """The examples of a public name's own docstring, those of its methods left out."""
    return doctest.DocTestFinder(recurse=False).find(getattr(og, name), name, module=False, globs={})[0]


@pytest.fixture(scope="module")
def known():
    """What other examples start from: the cloud that LabelledCloud's own makes, and the scene of fit's."""
    start = {}
    shared = {
        "LabelledCloud": ("cloud", "np", "og"),
        "fit": ("scene", "wall"),
    }
    for source, names in shared.items():
        example = example_of(source)
        assert doctest.DocTestRunner(optionflags=OPTIONS).run(example, clear_globs=False).failed == 0
        start |= {name: example.globs[name] for name in names}
    return start


@pytest.mark.parametrize("name", sorted(set(og.__all__) - CONSTANTS))
def test_each_public_name_has_an_example(name):
    assert len(example_of(name).examples) > 0


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_of_each_module_hold(path, known):
    top = next(parent for parent in (ROOT / "export", ROOT / "plugins", ROOT) if parent in path.parents)
    module = importlib.import_module(".".join(path.relative_to(top).with_suffix("").parts))
    result = doctest.testmod(module, optionflags=OPTIONS, extraglobs=known)
    assert result.attempted > 0
    assert result.failed == 0
