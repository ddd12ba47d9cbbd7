#!/usr/bin/env bash
# PyTables: with an index on a float16 column that holds negative numbers, queries find no rows, and no message comes.
#
# Expected: an index makes a query faster and does not change its rows. If a type cannot be indexed, an error says so,
#           as one does for complex numbers.
# Seen:     among 20,000 normal numbers in a Float16Col "x > 1" finds 0 rows instead of 3203, "x < 0" 0 of 10043, and
#           "x == -1" 0 of 11. "x > -1" and "x > 0" happen to be right. read_sorted() gives the positive numbers first
#           and then the negative ones from 0 downwards, though is_csi says that the index is completely sorted. With
#           numbers that are not negative, with float32 and with int16 all is right. The cause: in the Cython module the
#           type for float16 is another name of uint16, so the keys are sorted by their bits, and the search then looks
#           for its bounds in an order that is not that of the numbers. The two light kinds of index fail in fewer
#           queries. The docstrings of create_index(), create_csindex() and Float16Col name no limit for the type.
# Versions: tables 3.11.1 (the newest), numexpr 2.14.2, numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-12-01.
# Matters:  half precision is a usual way to keep large sets of trajectories small. A filter on the reward, the
#           return-to-go or a coordinate of the state silently selects nothing, or too little, as soon as an index is
#           built. Tests on rewards of 0 and 1 do not show it; costs, advantages and coordinates have both signs.
# Way out:  store the column that is to be indexed as Float32Col.
set -eu

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile --only-binary=:all: \
    tables==3.11.1 blosc2==4.14.1 numexpr==2.14.2 numpy==2.4.6

cd "$folder"
NUMEXPR_NUM_THREADS=1 BLOSC_NTHREADS=1 "$folder/venv/bin/python" - <<'PYTHON'
import sys
import warnings
import numexpr
import numpy as np
import tables

print(f"tables {tables.__version__}, numexpr {numexpr.__version__}, numpy {np.__version__}")
ROWS = 20_000
# In half precision the thresholds are exact, so the queries mean the same for each of the types.
QUERIES = {
    "x > 1": lambda x: x > 1,
    "x < 0": lambda x: x < 0,
    "x == -1": lambda x: x == -1,
    "x > -1": lambda x: x > -1,
    "x > 0": lambda x: x > 0,
}
KINDS = ("none", "ultralight", "light", "medium", "full")


def stop(text):
    sys.exit(f"The behaviour changed: {text}")


def counts(numbers, kind):
    """The number of rows that each query finds with an index of this kind, and the sorted column if it is full."""
    with tables.open_file("steps.h5", "w") as file:
        steps = file.create_table("/", "steps", {"x": tables.Col.from_dtype(numbers.dtype)})
        rows = np.empty(len(numbers), steps.dtype)
        rows["x"] = numbers
        steps.append(rows)
        steps.flush()
        if kind == "full":
            steps.cols.x.create_csindex()
        elif kind != "none":
            steps.cols.x.create_index(kind=kind)
        indexed = all(steps.will_query_use_indexing(query) for query in QUERIES)
        if indexed != (kind != "none"):
            stop("the queries were expected to use the index if there is one.")
        found = [len(steps.read_where(query)) for query in QUERIES]
        if kind != "full":
            return found, None
        if not steps.cols.x.index.is_csi:
            stop("the index was expected to call itself completely sorted.")
        return found, steps.read_sorted("x")["x"]


normal = np.random.default_rng(0).standard_normal(ROWS)
normal[:4] = -1
COLUMNS = {
    "float16": normal.astype(np.float16),
    "float16, not negative": np.abs(normal).astype(np.float16),
    "float32": normal.astype(np.float16).astype(np.float32),
    "int16": np.round(normal * 3).astype(np.int16),
}
print("rows found, index         " + " ".join(f"{query:>8}" for query in QUERIES))
for name, column in COLUMNS.items():
    right = [int(test(column).sum()) for test in QUERIES.values()]
    print(f"  {name}: NumPy".ljust(25), " ".join(f"{count:8}" for count in right))
    for kind in KINDS:
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always")
            found, in_order = counts(column, kind)
        # For float32 PyTables itself overflows in a cast to infinity. That changes nothing.
        if messages and name != "float32":
            stop(f"no message was expected: {messages[0].message}")
        print(f"    {kind}".ljust(25), " ".join(f"{count:8}" for count in found))
        if kind == "none" or name != "float16":
            if found != right:
                stop(f"{right} were expected.")
        elif kind in ("medium", "full"):
            if found != [0, 0, 0, *right[3:]]:
                stop("no rows were expected for the first three queries.")
        elif found != [right[0], 0, 0, *right[3:]]:
            stop("no rows were expected for the second and the third query.")
        if in_order is None:
            continue
        print(f"    read_sorted(): {in_order[0]:g}, {in_order[1]:g}, ..., {in_order[-2]:g}, {in_order[-1]:g}")
        by_bits = column[np.argsort(column.view(np.uint16), kind="stable")] if name == "float16" else np.sort(column)
        if not np.array_equal(in_order, by_bits):
            stop("the order of the bits was expected for float16 and that of the numbers for the others.")

with tables.open_file("steps.h5", "w") as file:
    steps = file.create_table("/", "steps", {"x": tables.ComplexCol(16)})
    try:
        steps.cols.x.create_index()
    except TypeError as error:
        print(f"complex numbers: TypeError: {error}")
    else:
        stop("an error was expected for complex numbers.")
PYTHON
