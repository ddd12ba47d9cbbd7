#!/usr/bin/env bash
# ml_dtypes: NumPy's sum, mean and deviation of bfloat16 stop growing at 256 ones; one NaN leaves np.sort unsorted.
#
# Expected: as for NumPy's own float16: sums are formed in a wider type, so the mean of 1,000 ones is 1; np.sort puts
#           NaN last and the numbers in order.
# Seen:     sums are formed in bfloat16, which has 8 bits: from 256 on, adding 1 changes nothing. The mean of 1,000 ones
#           is 0.256, their deviation 0.504, the mean of 100,000 numbers around 5 is 0.041; there is no message. A dot
#           product and linalg.norm of the same ones are right, because they are formed in float32 and double. Sorting
#           five numbers of which the third is NaN leaves 1 3 nan 0 2, and np.unique keeps equal numbers twice: every
#           comparison with NaN is false, and the type has no order of its own that puts it last.
# Versions: ml_dtypes 0.6.0, numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01. Issue 63 of ml_dtypes is
#           about the mean.
# Matters:  ml_dtypes is how JAX hands bfloat16 to NumPy. Whoever checks a dump of bf16 weights, activations or states
#           by mean and deviation, or normalises states by them, gets numbers that are wrong by a factor of 100, the
#           more wrong the more rows; what sorting is for, ranks and quantiles by hand, fails if the dump holds a NaN.
# Way out:  .astype(numpy.float32) first, or dtype=numpy.float32 in sum, mean and std.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile ml_dtypes==0.6.0 numpy==2.4.6

"$folder/venv/bin/python" - <<'PYTHON'
import sys
import ml_dtypes
import numpy as np

print(f"ml_dtypes {ml_dtypes.__version__}, numpy {np.__version__}")
bfloat16 = ml_dtypes.bfloat16


def check(label, value, expected):
    print(f"  {label:58} {value}")
    if not np.array_equal(value, expected, equal_nan=True):
        sys.exit(f"The behaviour changed: {expected} was expected.")


def rounded(value):
    return round(float(value), 3)


print("1,000 ones:")
ones = np.ones(1000, bfloat16)
check("sum, mean, deviation in bfloat16", [rounded(f(ones)) for f in (np.sum, np.mean, np.std)], [256, 0.256, 0.504])
half = ones.astype(np.float16)
check("the same in float16", [rounded(f(half)) for f in (np.sum, np.mean, np.std)], [1000, 1, 0])
check("dot product and norm squared in bfloat16", [rounded(np.dot(ones, ones)), rounded(np.linalg.norm(ones) ** 2)],
      [1000, 1000])
check("the way out: mean with dtype=float32", rounded(np.mean(ones, dtype=np.float32)), 1)

print("100,000 normal numbers around 5, of deviation 1:")
numbers = (5 + np.random.default_rng(0).standard_normal(100000)).astype(bfloat16)
check("mean in bfloat16 is below 0.1", float(np.mean(numbers)) < 0.1, True)
check("mean of the same as float32, to a tenth", round(float(np.mean(numbers.astype(np.float32))), 1), 5.0)

print("Sorting 3 1 nan 2 0:")
some = np.array([3, 1, np.nan, 2, 0])
check("in bfloat16", np.sort(some.astype(bfloat16)).astype(np.float32), [1, 3, np.nan, 0, 2])
check("in float16", np.sort(some.astype(np.float16)).astype(np.float32), [0, 1, 2, 3, np.nan])
twice = np.array([1, np.nan, 1, np.nan, 2], bfloat16)
check("unique of 1 nan 1 nan 2 in bfloat16", np.unique(twice).astype(np.float32), [1, np.nan, 1, np.nan, 2])
PYTHON
echo "Confirmed: bfloat16 sums saturate in NumPy, and a NaN leaves a sorted array unsorted."
