#!/usr/bin/env bash
# safetensors 0.8.0 (NumPy front end) stores a transposed array in memory order, under the transposed shape.
#
# Expected: save() of a strided view stores its elements in row-major order, as 0.7.0 does, or refuses it.
# Seen:     0.8.0 stores the bytes as they lie in memory. w.T comes back as the numbers of w in the shape of w.T,
#           without a message; w[:, ::2] and Fortran-ordered arrays come back wrong as well.
# Versions: safetensors 0.7.0 (right), 0.8.0 (wrong); numpy 2.4.6; CPython 3.11, x86-64 Linux. Seen on 2026-11-29.
# Matters:  GPT-2's Conv1D holds (inputs, outputs) and a linear layer (outputs, inputs), so a script that carries the
#           weights of a decision transformer over writes w.T. The attention's c_proj is square: there not even the
#           shape could show a reader the error.
# Way out:  numpy.ascontiguousarray(w.T) before save().
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat > "$folder/transposed.py" <<'PYTHON'
import sys
import numpy as np
import safetensors
from safetensors.numpy import load, save

views_are_right = sys.argv[1] == "right"
print(f"safetensors {safetensors.__version__}, numpy {np.__version__}")


def returned(array):
    return load(save({"w": array}))["w"]


square = np.arange(9, dtype=np.float32).reshape(3, 3)
wide = np.arange(8, dtype=np.float32).reshape(2, 4)
views = {
    "square.T": square.T,
    "wide.T": wide.T,
    "wide[:, ::2]": wide[:, ::2],
    "asfortranarray(wide)": np.asfortranarray(wide),
}
for name, view in views.items():
    back = returned(view)
    right = np.array_equal(back, view)
    print(f"  {name:21} saved {view.tolist()}")
    print(f"  {'':21} read  {back.tolist()}  {'right' if right else 'WRONG'}")
    if back.shape != view.shape:
        sys.exit("The behaviour changed: the shape was expected to be kept.")
    if right != views_are_right:
        sys.exit(f"The behaviour changed: the values were expected to be {sys.argv[1]}.")
    if not np.array_equal(returned(np.ascontiguousarray(view)), view):
        sys.exit("The behaviour changed: a contiguous copy was expected to come back right.")
if not views_are_right and not np.array_equal(returned(square.T), square):
    sys.exit("The behaviour changed: square.T was expected to come back as square.")
PYTHON

for case in 0.7.0:right 0.8.0:wrong; do
    version=${case%%:*}
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet --disable-pip-version-check --no-compile \
        "safetensors==$version" numpy==2.4.6
    "$folder/$version/bin/python" "$folder/transposed.py" "${case##*:}"
done
echo "Confirmed: 0.7.0 stores strided arrays rightly; 0.8.0 stores them in memory order, silently."
