#!/usr/bin/env bash
# PyNNDescent: with the metric "cosine" all keys more than 90 degrees away are equally far; any of them are returned.
#
# Expected: the cosine distance lies between 0 and 2, as the formula in the docstring of pynndescent.distances.cosine
#           says, and as SciPy, scikit-learn and that very function have it. The nearest keys are returned even if they
#           lie on the other side of the origin.
# Seen:     a query that has no key within 90 degrees gets ten arbitrary keys, each with the distance 1 exactly. Their
#           true distances go up to 1.91, while the nearest keys are at 1.00 to 1.37: 4 % of the ten nearest of 2000
#           keys are found. On the keys' side of the origin it is 99.5 %, and the distances are right. "dot" on unit
#           vectors is the same as "cosine". "inner_product", which the docstring of "dot" recommends, gives all keys
#           with a negative inner product the distance 0; it finds 6 % of the largest ones if they are negative. The
#           approximate search is not to blame: on the same arrays (the rows have mean 0) "correlation" finds all, and
#           so does "euclidean" on the unit vectors; a wider search (epsilon=1) does not help. If 4 keys lie within
#           90 degrees, these come first, and the other 6 of the ten are arbitrary. There is no message. The cause: the
#           search takes log2(1 / cos) instead, and the largest float32 where cos <= 0, so these keys are tied. Only the
#           docstrings of the internal functions and of "dot" tell; those of NNDescent and of "cosine" do not.
# Versions: pynndescent 0.7.0 (the newest; "cosine" and "dot" of 0.5.13, tried by hand, are alike), numba 0.68.1,
#           scikit-learn 1.9.1, numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  the memory holds the keys of the offline data, with the mean taken off. An agent that goes online elsewhere
#           asks from the other side of the origin. It should get the least dissimilar memories, and gets random ones of
#           equal weight. Where every step costs, features times task weights are negative for all memories, and the
#           best one is not found.
# Way out:  divide the vectors by their length and take "euclidean", which has the same order: cosine = d * d / 2. For
#           inner products append a coordinate that makes all keys equally long (and 0 to the queries) before that.
#
# Output seen on 2026-12-01, of its 18 lines these:
#   cosine, same side                  found  99.5 %, distances   0.004 to  0.245, truly   0.004 to  0.245
#   cosine, other side                 found   4.4 %, distances   1.000 to  1.000, truly   1.067 to  1.913
#   correlation, other side            found 100.0 %, distances   1.004 to  1.504, truly   1.004 to  1.504
#   cosine, ranks 1 to 4               found 100.0 %, distances   0.038 to  0.597, truly   0.038 to  0.597
#   cosine, ranks 5 to 10              found   3.6 %, distances   1.000 to  1.000
#   inner_product, other side          found   6.4 %, distances   0.000 to  0.000, truly   0.319 to 11.188
#   euclidean, lengthened, other side  found 100.0 %, distances   4.868 to  5.058, truly   0.026 to  3.500
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile --only-binary=:all: \
    pynndescent==0.7.0 numba==0.68.1 llvmlite==0.50.0 scikit-learn==1.9.1 scipy==1.17.1 joblib==1.6.0 numpy==2.4.6

cd "$folder"
OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 "$folder/venv/bin/python" - <<'PYTHON'
import sys
import warnings
from importlib.metadata import version
import numpy as np
from pynndescent import NNDescent, distances

warnings.simplefilter("ignore")  # remarks of Numba about its threading layer
print(", ".join(f"{name} {version(name)}" for name in ("pynndescent", "numba", "scikit-learn", "numpy")))
KEYS, QUERIES, SIZE, NEAREST = 2000, 100, 8, 10
random = np.random.default_rng(0)
centre = random.standard_normal(SIZE)
centre -= centre.mean()
centre *= 2.5 / np.linalg.norm(centre)


def around(point, count):
    """Vectors with mean 0 around a point. With mean 0 the cosine distance is the correlation distance."""
    vectors = point + 0.6 * random.standard_normal((count, SIZE))
    return (vectors - vectors.mean(axis=1, keepdims=True)).astype(np.float32)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def cosine(queries, keys):
    return 1 - unit(queries.astype(np.float64)) @ unit(keys.astype(np.float64)).T


def inner(queries, keys):
    return -queries.astype(np.float64) @ keys.astype(np.float64).T


def lengthened(vectors, radius):
    squares = np.maximum(0, radius ** 2 - np.sum(vectors.astype(np.float64) ** 2, axis=1))
    return np.column_stack([vectors, np.sqrt(squares)]).astype(np.float32)


def stop(text):
    sys.exit(f"The behaviour changed: {text}")


def share(returned, truth):
    """The part of the truly nearest keys that was returned."""
    nearest = np.argsort(truth, axis=1)[:, :returned.shape[1]]
    return np.mean([len(set(a) & set(b)) for a, b in zip(returned, nearest)]) / returned.shape[1]


def built(keys, metric):
    return NNDescent(keys, metric=metric, n_neighbors=30, random_state=0, n_jobs=1)


def show(title, returned, given, truth):
    own = np.take_along_axis(truth, returned, axis=1)
    found = share(returned, truth)
    best = truth.min(axis=1)
    print(f"  {title:34} found {100 * found:5.1f} %, distances {given.min():7.3f} to {given.max():6.3f},"
          f" truly {own.min():7.3f} to {own.max():6.3f}, nearest {best.min():7.3f} to {best.max():6.3f}")
    return found


def ask(title, index, queries, truth, square=False, epsilon=0.3):
    returned, given = index.query(queries, k=NEAREST, epsilon=epsilon)
    given = given ** 2 / 2 if square else given
    return show(title, returned, given, truth), returned, given


keys, near, far = around(centre, KEYS), around(centre, QUERIES), around(-centre, QUERIES)
far = far[cosine(far, keys).min(axis=1) > 1.001]  # those that have no keys within 90 degrees
print(f"{KEYS} keys; {len(near)} queries on their side and {len(far)} on the other side of the origin, k = {NEAREST}")
pair = float(distances.cosine(far[0], keys[0])), float(cosine(far[:1], keys[:1])[0, 0])
print(f"  distances.cosine of a query and a key is {pair[0]:.4f}, NumPy's is {pair[1]:.4f}")
if abs(pair[0] - pair[1]) > 1e-4 or pair[1] < 1.1:
    stop("distances.cosine was expected to be right.")

for metric, form, square in (("cosine", np.asarray, False), ("dot", unit, False), ("correlation", np.asarray, False),
                             ("euclidean", unit, True)):
    index = built(form(keys), metric)
    tied = metric in ("cosine", "dot")
    found, returned, given = ask(f"{metric}, same side", index, form(near), cosine(near, keys), square)
    if found < 0.95:
        stop(f"{metric} was expected to find the nearest keys on the same side.")
    found, returned, given = ask(f"{metric}, other side", index, form(far), cosine(far, keys), square)
    if tied and not (found < 0.3 and np.all(given == 1)) or not tied and not (found > 0.95 and given.min() > 1):
        stop(f"{metric} was expected to find {'arbitrary keys at distance 1' if tied else 'the nearest keys'}.")
    if metric == "cosine":
        found, returned, given = ask("cosine, other side, epsilon=1", index, far, cosine(far, keys), epsilon=1)
        if found > 0.3:
            stop("a wider search was expected not to help.")

print(f"the same with 4 keys more, on the side of the {len(far)} queries")
mixed = np.concatenate([keys, around(-centre, 4)])
truth = cosine(far, mixed)
inside = np.sum(truth < 1, axis=1)
returned, given = built(mixed, "cosine").query(far, k=NEAREST, epsilon=0.3)
show("cosine, ranks 1 to 4", returned[:, :4], given[:, :4], truth)
ranked = np.argsort(truth, axis=1)[:, 4:NEAREST]
rest = np.mean([len(set(a) & set(b)) for a, b in zip(returned[:, 4:], ranked)]) / (NEAREST - 4)
print(f"  {f'cosine, ranks 5 to {NEAREST}':34} found {100 * rest:5.1f} %, distances {given[:, 4:].min():7.3f}"
      f" to {given[:, 4:].max():6.3f}")
if np.any(inside != 4) or share(returned[:, :4], truth) < 0.95 or rest > 0.3 or np.any(given[:, 4:] != 1):
    stop("the 4 keys within 90 degrees were expected first, and arbitrary ones at distance 1 behind them.")

print("inner products, of which all are negative on the other side; the distance is the negative inner product")
radius = np.linalg.norm(keys.astype(np.float64), axis=1).max()
index = built(keys, "inner_product")
found, returned, given = ask("inner_product, same side", index, near, inner(near, keys))
lost, returned, given = ask("inner_product, other side", index, far, inner(far, keys))
if found < 0.95 or lost > 0.3 or np.any(given != 0):
    stop("inner_product was expected to be right on the same side, and arbitrary with distance 0 on the other.")
index = built(lengthened(keys, radius), "euclidean")
queries = np.column_stack([unit(far), np.zeros(len(far))]).astype(np.float32)
returned, given = index.query(queries, k=NEAREST, epsilon=0.3)
found = show("euclidean, lengthened, other side", returned, given, inner(far, keys))
if found < 0.9:
    stop("the way out was expected to find the largest inner products.")
PYTHON
echo "Confirmed: PyNNDescent does not tell apart the keys that are more than 90 degrees away from a query."
