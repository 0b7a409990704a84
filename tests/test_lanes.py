"""Vectors in compiled code against numpy, number by number."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.random import Generator

from og_pointcloud.rendering.lanes import WIDTH, any_of, broadcast, exp2, iota, load, minimum, select, store


@njit
def arithmetic(a, b, out):
    x, y = load(a, 0), load(b, 0)
    results = (
        x + y,
        x - y,
        x * y,
        minimum(x, y),
        select(x > y, iota(), broadcast(out[0])),
        select(x >= y, iota(), broadcast(out[0])),
    )
    for k in range(len(results)):
        store(out, k * WIDTH, results[k])


@njit
def power(a, out):
    store(out, 0, exp2(load(a, 0)))


@njit
def is_any_above(a, limit):
    return any_of(load(a, 0) > broadcast(limit))


def test_operations_are_those_of_numpy(random: Generator) -> None:
    a, b = random.normal(size=(2, WIDTH)).astype(np.float32)
    a[3], b[5], a[7], b[7] = np.inf, -np.inf, 2, 2
    out = np.full(6 * WIDTH, -5, np.float32)
    arithmetic(a, b, out)
    lanes = np.arange(WIDTH, dtype=np.float32)
    chosen = [np.where(of, lanes, np.float32(-5)) for of in (a > b, a >= b)]
    expected = [a + b, a - b, a * b, np.minimum(a, b), *chosen]
    np.testing.assert_array_equal(out.reshape(6, WIDTH), expected)


def test_not_a_number_is_less_than_nothing() -> None:
    a, b = np.full(WIDTH, np.nan, np.float32), np.ones(WIDTH, np.float32)
    out = np.zeros(6 * WIDTH, np.float32)
    arithmetic(a, b, out)
    np.testing.assert_array_equal(out.reshape(6, WIDTH)[3:], [[1] * WIDTH, [0] * WIDTH, [0] * WIDTH])


def test_powers_of_two_have_the_precision_of_float32() -> None:
    exponents = np.concatenate([np.linspace(-126, 0.5, 100_000), np.arange(-126, 1), [-0.5, -1.5, -7.994353]])
    exponents = np.resize(exponents, -(-len(exponents) // WIDTH) * WIDTH).astype(np.float32)
    actual = np.empty_like(exponents)
    for begin in range(0, len(exponents), WIDTH):
        power(exponents[begin : begin + WIDTH], actual[begin : begin + WIDTH])
    error = np.abs(actual / np.exp2(exponents.astype(np.float64)) - 1)
    assert error.max() < 3e-7


def test_any_lane_counts(random: Generator) -> None:
    for lane in range(WIDTH):
        a = np.zeros(WIDTH, np.float32)
        a[lane] = 1
        assert is_any_above(a, np.float32(0.5))
        assert not is_any_above(a, np.float32(1))
