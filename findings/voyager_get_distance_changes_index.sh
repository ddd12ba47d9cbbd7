#!/usr/bin/env bash
# Voyager: in the space InnerProduct, get_distance() is not the distance of query(), and calling it changes the index.
#
# Expected: get_distance(a, b), "the distance between two provided vectors", is 1 - a.b in this space, as the distances
#           of query() are. It depends on a and b alone, and reading a distance leaves the index as it is.
# Seen:     1. It is 1 - a.b - floor(sqrt(m^2 - |a|^2)) floor(sqrt(m^2 - |b|^2)), where m is the largest length among
#              all vectors that the index has met. One pair of vectors has the distance 0.457 in an empty index, -24.5
#              in one with 2000 others, and -1295.5 after a vector nearly six times as long as the longest of those. The
#              order is another one, too: 23 % of the ten keys nearest by get_distance() are so by 1 - a.b. query()
#              itself gives 1 - a.b.
#           2. m takes in the vectors given to get_distance() as well. One call with a long vector, which is not added
#              to the index, changes all later distances. Moreover, what is added after it is stored with a coordinate
#              made from m: of the same 2000 vectors, with such a call half-way, query() finds 37 % of the ten nearest
#              instead of 69 %.
#           Euclidean and Cosine are right. There is no message. The cause is the coordinate sqrt(m^2 - |x|^2) that
#           turns the search for inner products into one for neighbours: query() sets it to 0 in its argument,
#           get_distance() gives both vectors theirs, cut down to a whole number. If no vector is longer than 1, it is
#           0, and all is right. The docstrings of get_distance() and Space do not name the coordinate.
# Versions: voyager 2.2.3 (the newest), numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  features times task weights are the value of a remembered step. Whoever checks a threshold or ranks a few
#           candidates with get_distance() favours short features, whatever the task, and the numbers drift as the
#           memory grows. Asking once with features that are not scaled spoils what is stored from then on.
# Way out:  1 - numpy.dot(a, b), with get_vector() for a stored key; or query().
#
# Output seen on 2026-12-01, of its 9 lines these:
#   1. a.b = 0.5430, so the distance is 0.4570. get_distance(a, b):
#      0.4570 in an empty index, -24.5430 with 2000 keys (the longest: 6.4), -1295.5430 after a key of length 36.7
#      get_distance(a, b) before and after get_distance(long, b): -24.5430, -1295.5430
#      of the 10 nearest keys query() finds 68.6 %; with such a call half-way 37.2 %
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile --only-binary=:all: \
    voyager==2.2.3 numpy==2.4.6

cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import sys
from importlib.metadata import version
import numpy as np
from voyager import Index, Space

print(f"voyager {version('voyager')}, numpy {np.__version__}")
SIZE, KEYS, QUERIES, NEAREST = 16, 2000, 200, 10
random = np.random.default_rng(0)
keys = random.standard_normal((KEYS, SIZE)).astype(np.float32)
queries = random.standard_normal((QUERIES, SIZE)).astype(np.float32)
long = 10 * keys[0]


def length(vector):
    return float(np.linalg.norm(vector.astype(np.float64)))


def inner(a, b):
    return 1 - a.astype(np.float64) @ b.astype(np.float64).T


def formula(a, b, met):
    """What get_distance() returns; met is the largest length that the index has met, a and b included."""
    def extra(x):
        return np.floor(np.sqrt(max(0.0, met ** 2 - length(x) ** 2)))
    return float(inner(a, b)) - extra(a) * extra(b)


def expect(condition, text):
    if not condition:
        sys.exit(f"The behaviour changed: {text}")


def close(a, b):
    return np.allclose(a, b, rtol=1e-4, atol=1e-4)


def filled(space=Space.InnerProduct, half_way=lambda index: None):
    index = Index(space, SIZE)
    for number, half in enumerate(np.split(keys, 2)):
        if number:
            half_way(index)
        index.add_items(half, num_threads=1)
    return index


def found(index):
    returned, distances = index.query(queries, NEAREST, num_threads=1)
    truth = inner(queries, keys)
    own = np.take_along_axis(truth, returned.astype(int), axis=1)
    expect(close(distances, own), "query() was expected to return 1 - a.b.")
    nearest = np.argsort(truth, axis=1)[:, :NEAREST]
    return np.mean([len(set(a) & set(b)) for a, b in zip(returned, nearest)]) / NEAREST


a, b = keys[1], queries[0]
print(f"1. a.b = {1 - float(inner(a, b)):.4f}, so the distance is {float(inner(a, b)):.4f}. get_distance(a, b):")
index = Index(Space.InnerProduct, SIZE)
fresh = index.get_distance(a, b)
index = filled()
met = max(length(key) for key in keys)
beside = index.get_distance(a, b)
index.add_item(long)
after = index.get_distance(a, b)
print(f"   {fresh:.4f} in an empty index, {beside:.4f} with {KEYS} keys (the longest: {met:.1f}),"
      f" {after:.4f} after a key of length {length(long):.1f}")
expect(close(fresh, inner(a, b)), "get_distance() was expected to be right in an empty index.")
expect(close(beside, formula(a, b, met)) and beside < fresh - 1, "another distance was expected beside the keys.")
expect(close(after, formula(a, b, length(long))) and after < fresh - 100, "another distance was expected after it.")

index = filled()
truth = np.argsort(inner(queries, keys), axis=1)[:, :NEAREST]
ranked = [np.argsort([index.get_distance(key, query) for key in keys])[:NEAREST] for query in queries[:50]]
same = np.mean([len(set(a) & set(b)) for a, b in zip(ranked, truth)]) / NEAREST
firsts = np.mean([np.sum(inner(query, keys) < inner(query, keys[row[0]])) for query, row in zip(queries, ranked)])
print(f"   {100 * same:.1f} % of the {NEAREST} nearest keys by get_distance() are so by 1 - a.b;"
      f" on average {firsts:.1f} keys are nearer than its first one")
expect(same < 0.4 and firsts > 10, "another order was expected.")

print("2. get_distance() as a reader of the index")
index = filled()
before = index.get_distance(a, b)
index.get_distance(long, b)
changed = index.get_distance(a, b)
print(f"   get_distance(a, b) before and after get_distance(long, b): {before:.4f}, {changed:.4f}")
expect(close(before, beside) and close(changed, formula(a, b, length(long))), "the call was expected to change it.")
shares = found(filled()), found(filled(half_way=lambda index: index.get_distance(long, b)))
print(f"   of the {NEAREST} nearest keys query() finds {100 * shares[0]:.1f} %;"
      f" with such a call half-way {100 * shares[1]:.1f} %")
expect(shares[1] < shares[0] - 0.1, "the call was expected to spoil what is added after it.")

for space, truth in ((Space.Euclidean, float(np.sum((a.astype(np.float64) - b) ** 2))),
                     (Space.Cosine, 1 - (1 - float(inner(a, b))) / length(a) / length(b))):
    index = filled(space, lambda index: index.get_distance(long, b))
    print(f"   {space.name}: {index.get_distance(a, b):.4f}, NumPy {truth:.4f}")
    expect(close(index.get_distance(a, b), truth), f"{space.name} was expected to be right.")
PYTHON
echo "Confirmed: Voyager's get_distance() for inner products depends on other vectors and changes the index."
