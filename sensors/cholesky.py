"""Cholesky factor, solution and inverse of a system with three unknowns per vehicle, for kernels.

Rows are as wide as `padded` says. Work is done on three rows at a time, in vector instructions. Blocks of zeros are
skipped: two vehicles that share no object have one.
"""

import numpy as np

from cosim.base.kernel import inlined, kernel
from sensors.lanes import COLUMNS, subtract_rows


@kernel
def factorise(a):
    """Replace the upper triangle of a positive definite matrix by its Cholesky factor, a vehicle at a time."""
    n = len(a)
    for i in range(0, n, 3):
        for k in range(0, i, 3):
            first = a[k]
            second = a[k + 1]
            third = a[k + 2]
            factors = (
                *(first[i], first[i + 1], first[i + 2]),
                *(second[i], second[i + 1], second[i + 2]),
                *(third[i], third[i + 1], third[i + 2]),
            )
            subtract(a, i, a, k, factors, i, n)
        for j in range(i, i + 3):
            row = a[j]
            for k in range(i, j):
                other = a[k]
                value = other[j]
                for c in range(j, n):
                    row[c] -= value * other[c]
            per = 1.0 / np.sqrt(row[j])
            for c in range(j, n):
                row[c] *= per


@inlined
def padded(n):
    """The number of columns that hold n."""
    return (n + COLUMNS - 1) // COLUMNS * COLUMNS


@inlined
def subtract(rows, i, of, k, factors, begin, end):
    """Subtract multiples of rows k, k + 1, ... from rows i, i + 1 and i + 2, in columns `begin` to `end` and beside."""
    size = 0.0
    for factor in factors:
        size += abs(factor)
    if size > 0.0:
        first = begin // COLUMNS * COLUMNS
        for column in range(np.uint64(first), np.uint64(end), np.uint64(COLUMNS)):
            subtract_rows(rows, i, of, k, factors, column)


@kernel
def solve(factor, x):
    """Replace the right side by the solution."""
    n = len(factor)
    for k in range(n):
        row = factor[k]
        value = x[k] / row[k]
        for i in range(k + 1, n):
            x[i] -= row[i] * value
        x[k] = value
    for i in range(n - 3, -1, -3):
        a = factor[i]
        b = factor[i + 1]
        c = factor[i + 2]
        u = v = w = 0.0
        for k in range(i + 3, n):
            u += a[k] * x[k]
            v += b[k] * x[k]
            w += c[k] * x[k]
        j, k = i + 1, i + 2
        r = (x[k] - w) / c[k]
        q = (x[j] - v - b[k] * r) / b[j]
        p = x[i] - u - a[j] * q - a[k] * r
        x[i] = p / a[i]
        x[j] = q
        x[k] = r


@kernel
def invert(factor, inverse):
    """Inverse of the matrix of a Cholesky factor U, from the last vehicle on: U times it is lower triangular.

    Both triangles are filled, the lower one with what is found for the upper one.
    """
    n = len(factor)
    inverse[:] = 0.0
    for i in range(n - 3, -1, -3):
        first = factor[i]
        second = factor[i + 1]
        third = factor[i + 2]
        for k in range(i + 3, n, 3):
            j, m = k + 1, k + 2
            factors = (
                *(first[k], second[k], third[k]),
                *(first[j], second[j], third[j]),
                *(first[m], second[m], third[m]),
            )
            subtract(inverse, i, inverse, k, factors, i + 3, n)
        for j in range(i + 2, i - 1, -1):
            row = inverse[j]
            for k in range(j + 1, i + 3):
                other, value = inverse[k], factor[j, k]
                for c in range(i + 3, n):
                    row[c] -= value * other[c]
            per = 1.0 / factor[j, j]
            for c in range(i + 3, n):
                row[c] *= per
                inverse[c, j] = row[c]
            for c in range(i + 2, j - 1, -1):
                other, value = inverse[c], per if c == j else 0.0
                for k in range(j + 1, n):
                    value -= factor[j, k] * other[k]
                row[c] = inverse[c, j] = value * per
