"""Every stiff and extreme case, on three values of its condition; that the catalogue can fail; where naive forms do."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from hard_cases import Case, find_cases, inputs, run_catalogue, text
from hard_cases.case import Answer, largest_error, run_case

from og_pointcloud.cli import main
from og_pointcloud.errors import FeatureSpaceError, OgPointcloudError, SceneError

NAIVE_BREAKS = {
    "needle": 1e6,
    "pancake": 1e6,
    "quaternion_length": 1e36,
    "near_plane": 1e-12,
    "offset": 1e8,
    "size": 1e-6,
    "lookup_offset": 1e8,
    "principal_point": 1e4,
    "feature_length": 1e-40,
    "eq2_gradient": 1e-7,
    "eq1_value": 1e-5,
    "eq2_descent": 1e-19,
    "kmeans_offset": 1e6,
    "vector_length": 1e37,
    "nearly_equal_words": 1e-5,
}


def _parameter(case: Case):
    return pytest.param(case, id=f"{case.family}-{case.name}")


@pytest.mark.parametrize("case", [_parameter(case) for case in find_cases(quick=True)])
def test_case_holds(case: Case):
    for row in run_case(case, quick=True):
        assert row.outcome == ("one clear error" if case.refusal else "agrees"), f"at {row.value}: {row.note}"


@pytest.mark.parametrize(("name", "value"), NAIVE_BREAKS.items(), ids=NAIVE_BREAKS)
def test_naive_form_breaks_where_ours_does_not(name: str, value: float):
    (case,) = find_cases([name])
    row = next(row for row in run_case(case, quick=True) if row.value == value)
    assert row.outcome == "agrees"
    assert row.naive is not None
    assert not row.naive <= max(100 * case.bound, 0.1)


def test_naive_form_holds_where_nothing_is_extreme():
    for name in ("needle", "offset", "kmeans_offset", "lookup_offset", "nearly_equal_words"):
        (case,) = find_cases([name])
        mildest = run_case(case, quick=True)[0]
        assert mildest.naive is not None
        assert mildest.naive <= max(case.bound, 1e-5), name


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        (lambda weights: weights * 1.001, "error"),
        (lambda weights: weights * np.nan, "not finite"),
        (lambda weights: weights[:, :-1], "shape"),
        (lambda weights: {}[0], "KeyError"),
    ],
    ids=["off by a thousandth", "NaN", "another shape", "an exception"],
)
def test_wrong_weights_are_reported(monkeypatch: pytest.MonkeyPatch, broken, says: str):
    right = inputs.dense_weights
    monkeypatch.setattr(inputs, "dense_weights", lambda *a, **k: broken(right(*a, **k)))
    rows = run_catalogue(find_cases(["needle"]), quick=True)
    assert {row.outcome for row in rows} == {"FAILS"}
    assert all(says in row.note for row in rows)


@pytest.mark.parametrize(
    ("instead", "says"),
    [
        (lambda *_: None, "no error"),
        (lambda *_: _raise(SceneError("the vector of 'chair' is zero, like nothing: encode it again")), "SceneError"),
        (lambda *_: _raise(FeatureSpaceError("the vector of 'chair' is zero, like nothing")), "does not say"),
        (lambda *_: _raise(ZeroDivisionError("zero")), "ZeroDivisionError"),
        (lambda *_: _raise(FeatureSpaceError("of 'chair' is zero, like nothing\nencode it again")), "does not say"),
    ],
    ids=["nothing", "another kind", "no cure", "a crash", "two lines"],
)
def test_anything_but_the_one_clear_error_is_reported(monkeypatch: pytest.MonkeyPatch, instead, says: str):
    monkeypatch.setattr(text, "segment", instead)
    (row,) = run_catalogue(find_cases(["vector_of_zero"]))
    assert row.outcome == "FAILS"
    assert says in row.note


def test_warning_of_numpy_fails_a_case():
    def dividing() -> Answer:
        """Divides by zero on the way."""
        return Answer(np.minimum(np.ones(1) / np.zeros(1), 1), np.ones(1))

    case = Case("dividing", "geometry", dividing, bound=1)
    assert run_case(case)[0].outcome == "FAILS"
    assert "RuntimeWarning" in run_case(case)[0].note


def test_largest_error():
    assert largest_error([1.0, 2.5], [1.0, 2.0]) == 0.25  # of the largest
    assert largest_error([0.5], [0.0]) == 0.5  # of 1 where all is zero
    assert largest_error([1, 2, 3, 4], [1, 2, 3, 5]) == 0.25  # share of integers
    assert largest_error([], np.zeros(0)) == 0
    assert np.isnan(largest_error([np.inf], [1.0]))
    assert np.isnan(largest_error([1.0], [1.0, 1.0]))


def test_every_case_has_a_name_of_its_own_and_says_what_it_is():
    cases = find_cases()
    assert len({case.name for case in cases}) == len(cases)
    for case in cases:
        assert case.title.endswith("."), case.name
        assert case.refusal is None or all(case.refusal[1]), case.name


def test_reference_agrees_with_the_plain_inverse_where_that_is_exact():
    gaussians, view = inputs.scatter(), inputs.camera()
    answer = inputs.splatted(gaussians, view)
    assert answer.naive is not None
    assert largest_error(answer.naive(), answer.reference) < 1e-5


def test_quick_leaves_the_slow_cases_out():
    slow = {case.name for case in find_cases() if case.slow}
    assert slow
    assert slow == {case.name for case in find_cases()} - {case.name for case in find_cases(quick=True)}


def test_unknown_name():
    with pytest.raises(OgPointcloudError, match=r"'needles' is no case.*did you mean 'needle'"):
        find_cases(["needles"])


def test_command_writes_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("matplotlib")
    assert main(["check", "--quick", "--only", "needle,vector_of_zero", "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("agrees") == 3
    assert printed.count("one clear error") == 1
    with (tmp_path / "out" / "check.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["value"] for row in rows] == ["1", "1000", "1e+06", ""]
    assert float(rows[2]["error"]) <= float(rows[2]["bound"]) < float(rows[2]["naive_error"])
    assert "is zero" in rows[3]["note"]
    assert (tmp_path / "out" / "check.png").read_bytes().startswith(b"\x89PNG")


def test_command_without_matplotlib(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["check", "--only", "scale_zero", "-o", str(tmp_path)]) == 0
    assert "og-pointcloud[report]" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["check.csv"]


def test_command_fails_with_a_case(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(text, "segment", lambda *_: None)
    assert main(["check", "--only", "vector_of_zero,scale_zero"]) == 2
    printed = capsys.readouterr()
    assert "1 of 2 cases fail: vector_of_zero" in printed.err
    assert "vector_of_zero: no error; expected FeatureSpaceError" in printed.out


def test_command_refuses_an_unknown_name(capsys: pytest.CaptureFixture[str]):
    assert main(["check", "--only", "neadle"]) == 2
    assert "'neadle' is no case" in capsys.readouterr().err


def _raise(error: Exception):
    raise error
