#!/usr/bin/env bash
# numpy.random.Philox.advance(n) moves on by n blocks of four numbers and drops the rest of a block begun.
#
# Expected: advance(n) skips n 64-bit numbers, as PCG64.advance(n) does. The two methods have the same docstring, word
#           for word but for the class's name: "as-if delta draws have occurred".
# Seen:     a new Philox skips 4 n numbers. After p numbers it is at 4 (ceil(p / 4) + n), so advance(0) moves as well
#           unless p is a multiple of 4. randomgen's Philox with the same key gives the same stream, and its advance(n)
#           skips n numbers exactly; it counts blocks only when asked to by counter=True. NumPy's page of the method
#           speaks of draws; that of the class says that advance moves "the counter", one for "every 4" numbers.
# Versions: numpy 2.4.6, randomgen 2.5.1; CPython 3.11, x86-64 Linux. Seen on 2026-11-30.
# Matters:  a counter-based generator is chosen so that a run may be resumed at draw n. A sampler of trajectories and
#           starts that is resumed by advance(draws so far) gets other batches than the run without a break, with no
#           message, and swapping PCG64 or randomgen's Philox for NumPy's changes the result likewise.
# Way out:  on a new generator advance(n // 4), then throw away n % 4 numbers.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check --no-compile numpy==2.4.6 randomgen==2.5.1

"$folder/venv/bin/python" - <<'PYTHON'
import sys
import numpy as np
import randomgen

print(f"numpy {np.__version__}, randomgen {randomgen.__version__}")
KEY = 7
MAKERS = {
    "numpy Philox": lambda: np.random.Philox(key=KEY),
    "numpy PCG64": lambda: np.random.PCG64(KEY),
    "numpy PCG64DXSM": lambda: np.random.PCG64DXSM(KEY),
    "randomgen Philox": lambda: randomgen.Philox(key=KEY, number=4, width=64),
}
same_text = np.random.PCG64.advance.__doc__.replace("PCG64", "Philox") == np.random.Philox.advance.__doc__
same_stream = np.array_equal(MAKERS["numpy Philox"]().random_raw(64), MAKERS["randomgen Philox"]().random_raw(64))
print(f"the docstrings of PCG64.advance and Philox.advance are the same: {same_text}")
print(f"NumPy's and randomgen's Philox give the same stream: {same_stream}")
if not (same_text and same_stream):
    sys.exit("The behaviour changed: both were expected to be the same.")


def position(make, before, delta):
    """The place in the stream of the number that follows: before numbers are drawn, then advance(delta) is called."""
    generator = make()
    for _ in range(before):
        generator.random_raw()
    generator.advance(delta)
    return make().random_raw(64).tolist().index(generator.random_raw())


DELTAS = (0, 1, 2, 3)
print("place after p numbers and advance(0), (1), (2), (3):")
for name, make in MAKERS.items():
    for before in (0, 1, 4, 5):
        places = [position(make, before, delta) for delta in DELTAS]
        print(f"  {name:16}  p = {before}: " + " ".join(f"{place:3}" for place in places))
        if name == "numpy Philox":
            expected = [4 * (-(-before // 4) + delta) for delta in DELTAS]
        else:
            expected = [before + delta for delta in DELTAS]
        if places != expected:
            sys.exit(f"The behaviour changed: {expected} was expected.")

# Three starts are drawn; the run is then resumed at the fourth.
starts = np.random.Generator(MAKERS["numpy Philox"]()).random(16)
resumed = np.random.Generator(MAKERS["numpy Philox"]().advance(3)).random()
exact = MAKERS["numpy Philox"]().advance(3 // 4)
for _ in range(3 % 4):
    exact.random_raw()
seek = np.random.Generator(exact).random()
print(f"start 4 of the whole run {starts[3]:.6f}, after advance(3) {resumed:.6f}, by the way out {seek:.6f}")
print(f"advance(3) gave start {starts.tolist().index(resumed) + 1}")
if seek != starts[3] or resumed != starts[12]:
    sys.exit("The behaviour changed: start 13 was expected after advance(3), and start 4 by the way out.")
PYTHON
