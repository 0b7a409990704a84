"""Every stiff and extreme case; that a case can fail; and where the plain float32 forms do."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hard_cases import Case, find_cases, inputs, text
from hard_cases.__main__ import main
from hard_cases.case import largest_error, run_case

from og_pointcloud.errors import FeatureSpaceError, SceneError

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
    "kmeans_offset": 1e6,
    "vector_length": 1e37,
    "nearly_equal_words": 1e-5,
}


def _parameters(cases: list[Case]) -> list:
    return [pytest.param(case, id=f"{case.family}-{case.name}") for case in cases]


@pytest.mark.parametrize("case", _parameters(find_cases(quick=True)))
def test_case_holds(case: Case):
    for row in run_case(case, quick=True):
        assert row.holds, f"at {row.value}: {row.note}"


@pytest.mark.slow
@pytest.mark.parametrize("case", _parameters([case for case in find_cases() if case.slow or len(case.values) > 3]))
def test_case_holds_everywhere(case: Case):
    for row in run_case(case):
        assert row.holds, f"at {row.value}: {row.note}"


@pytest.mark.parametrize(("name", "value"), NAIVE_BREAKS.items(), ids=NAIVE_BREAKS)
def test_naive_form_breaks_where_ours_does_not(name: str, value: float):
    (case,) = find_cases([name])
    row = next(row for row in run_case(case, quick=True) if row.value == value)
    assert row.holds
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
        (lambda weights: weights * 1.001, "error 0.001"),
        (lambda weights: weights * np.nan, "error nan"),
        (lambda weights: weights[:, :-1], "shape"),
        (lambda weights: {}[0], "KeyError"),
        (lambda weights: weights / np.zeros(1), "RuntimeWarning"),
    ],
    ids=["off by a thousandth", "NaN", "another shape", "an exception", "a warning of numpy"],
)
def test_wrong_weights_are_reported(monkeypatch: pytest.MonkeyPatch, broken, says: str):
    right = inputs.dense_weights
    monkeypatch.setattr(inputs, "dense_weights", lambda *a, **k: broken(right(*a, **k)))
    rows = run_case(find_cases(["needle"])[0], quick=True)
    assert not any(row.holds for row in rows)
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
    (row,) = run_case(find_cases(["vector_of_zero"])[0])
    assert not row.holds
    assert says in row.note


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


def test_make_check_writes_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["--quick", "--only", "needle,tied_groups,vector_of_zero", "-o", str(tmp_path / "out")]) == 0
    assert "3 cases (1 float64, 1 exact, 1 refused), 0 of them fail" in capsys.readouterr().out
    with (tmp_path / "out" / "check.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["float64"] * 3 + ["exact", "refused"]
    assert [row["value"] for row in rows] == ["1", "1000", "1e+06", "", ""]
    assert float(rows[2]["error"]) <= float(rows[2]["bound"]) < float(rows[2]["naive_error"])
    assert "is zero" in rows[4]["note"]
    assert (tmp_path / "out" / "check.png").read_bytes().startswith(b"\x89PNG")


def test_make_check_fails_with_a_case(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(text, "segment", lambda *_: None)
    assert main(["--only", "vector_of_zero,scale_zero"]) == 1
    printed = capsys.readouterr().out
    assert "1 of them fail: vector_of_zero" in printed
    assert "no error; expected FeatureSpaceError" in printed


def test_unknown_case(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["--only", "needles"])
    assert "'needles' is no case" in capsys.readouterr().err


def _raise(error: Exception):
    raise error
